"""Every step of docs/your_robot.md, in its order, on a robot that `config/` does not know.

The recordings are a sqlite3 bag with TF, the robot's description, JPEG and YUV images and no
commands. The node's line of the page is not run here: it ends when it is stopped (test/ros).
"""

from pathlib import Path
import shlex
import shutil

from bags import record
from crane import FPS, load, make_cameras, make_positions
import pytest
from test_import_bag import MAPPING
from test_own_checkpoint import TINY
import yaml

from mtv_world_ros.cli import main

PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'your_robot.md'
#: names on the page, and those of the test's robot
NAMES = {'my_robot': 'crane', 'first_bag': 'wave', 'front,side': 'door,palm'}
#: keep the commands small
SMALL = {
    'train': ['--threads', '1', *(word for item in TINY for word in ('--set', item))],
    'evaluate': ['--no-ceiling', '--actions', 'true', '--threads', '1', '--no-report'],
}
#: exit status of `doctor`: the camera on the hand cannot be checked
STATUS = {'doctor': 3}


def lines() -> list[list[str]]:
    """Words of the page's `mtv-world` lines, one after the other."""
    text = PAGE.read_text()
    for name, own in NAMES.items():
        text = text.replace(name, own)
    blocks = [part.split('```')[0] for part in text.split('```bash\n')[1:]]
    return [shlex.split(line) for block in blocks for line in block.splitlines() if line]


@pytest.fixture(scope='module')
def desk(tmp_path_factory):
    """Folder with the robot's URDF and meshes, its bags, and their mapping."""
    folder = tmp_path_factory.mktemp('desk')
    robot, cameras = load(folder), make_cameras()
    del cameras['window']
    bag = folder / 'recordings' / 'wave'
    bag.parent.mkdir()
    record(bag, robot, cameras, make_positions(4.0, fps=FPS), sqlite=True)
    shutil.move(folder / 'crane' / 'crane.urdf', folder / 'crane.urdf')
    (folder / 'crane' / 'crane.yaml').unlink()
    (folder / 'my_bags.yaml').write_text(yaml.safe_dump(MAPPING))
    return folder


def test_the_page_leads_from_a_urdf_to_predictions(desk, monkeypatch, capsys):
    monkeypatch.chdir(desk)
    done = []
    for words in lines():
        if words[0] != 'mtv-world':
            assert words[0] == 'world_model'
            continue
        command = words[1]
        status = main([*words[1:], *SMALL.get(command, [])])
        said = capsys.readouterr()
        assert status == STATUS.get(command, 0), f'{words}: {said.out}{said.err}'
        done.append(command)
    assert done == ['robot', 'import-bag', 'doctor', 'train', 'evaluate', 'replay']
    assert (desk / 'out' / 'mine' / 'metrics.json').is_file()
