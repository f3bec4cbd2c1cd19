"""Shell lines of the README and the docs: all are checked, those that are cheap are run.

A block of lines is run, in the order of the pages and in one temporary folder, unless a comment
before it says what it needs that is not at hand: `<!-- needs: gpu -->`, see `NEEDS`. A comment
`<!-- small: --episodes 1 -->` appends options to the `mtv-world` lines of the block when they are
run here. Lines that are not run are checked against the real command line all the same.

What comes of a block stands on the page, and is compared: `<!-- shows: TEXT -->` before it (`...`
= anything) is in what it prints, `<!-- makes: PATHS -->` are files and folders that it leaves, and
`<!-- printed -->` before a `text` block after it is all that it prints. `<!-- file: NAME -->`
before a block of Python or YAML is a file that the lines below it find.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
import contextlib
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from importlib.util import find_spec
import io
from pathlib import Path
import re
import runpy
import shlex
import subprocess
import sys
import traceback
from typing import Any

import pytest
import yaml

from mtv_world_ros.cli import main, make_parser
from mtv_world_ros.cli.commands import COMMANDS
from mtv_world_ros.core.errors import MtvWorldError
from mtv_world_ros.simulation.opengl import missing_opengl
from test.support.tables import table

ROOT = Path(__file__).resolve().parents[2]
#: what a block may need; those with a function are run where it returns nothing
NEEDS: dict[str, Callable[[], str | None] | None] = {
    'data': None,
    'gpu': None,
    'native_ros': None,
    'network': None,
    'opengl': missing_opengl,
    'rclpy': lambda: None if find_spec('rclpy') else 'rclpy is not installed',
    'root': None,
    'ros': None,  # runs until it is stopped, or waits for somebody; test/ros has such tests
    'server': None,
    'time': None,
    'weights': None,
}
LANGUAGES = {'bash', 'python', 'text', 'yaml'}
#: has the options that `mtv-world replay` passes on
PLAYER = ROOT / 'mtv_world_ros' / 'ros' / 'bags' / 'player.py'
#: folders of the repository that lines may name files of
FOLDERS = (
    'config',
    'docs',
    'examples',
    'experiments',
    'launch',
    'requirements',
    'resource',
    'robustness',
    'test',
)
#: options of other programs that the texts mention
FOREIGN_OPTIONS = {
    '--feedback', '--generate', '--head', '--show-args', '--symlink-install',
    '--system-site-packages',
}  # fmt: skip
_COMMENT = re.compile(r'<!-- (needs|small|shows|makes|file|printed)(?:: (.+?))? -->')
_CODE = re.compile(r'`([^`\n]+)`')


@dataclass(kw_only=True)
class Block:
    """Shell lines of one code block, and the comments before it."""

    page: str
    number: int
    lines: list[str] = field(default_factory=list)
    needs: list[str] = field(default_factory=list)
    small: str = ''
    shows: list[str] = field(default_factory=list)
    makes: list[str] = field(default_factory=list)
    printed: str = ''
    files: dict[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f'{self.page}:{self.number}'

    def commands(self) -> Iterator[list[str]]:
        """Words of each command, one after the other."""
        for line in '\n'.join(self.lines).replace('\\\n', ' ').splitlines():
            words = shlex.shlex(line, posix=True, punctuation_chars='&|;')
            words.whitespace_split, words.commenters = True, '#'
            command: list[str] = []
            for word in [*words, '&&']:
                if word != '&&':
                    command.append(word)
                elif command:
                    yield command
                    command = []

    def obstacle(self) -> str:
        """Why it is not run here; empty = it is."""
        for need in self.needs:
            word = need.split(' ')[0]
            probe = NEEDS[word]
            reason = need if probe is None else probe()
            if reason:
                return f'checked, not run: needs {word}'
        return ''


def pages() -> list[Path]:
    """The README, the pages in the order of the site, and what else shows commands."""
    text = (ROOT / 'mkdocs.yml').read_text()
    names = re.findall(r'- (?:.+: )?(\w+\.md)$', text, re.M)
    return [
        ROOT / 'README.md',
        *(ROOT / 'docs' / name for name in names),
        ROOT / 'CONTRIBUTING.md',
    ]


def fences(text: str) -> Iterator[tuple[int, str, list[str], list[str]]]:
    """Line number, language, lines and comments before of every code block."""
    comments: list[str] = []
    inside: tuple[int, str, list[str]] | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        mark = re.match(r'\s*```(\w*)', line)
        if mark and inside is None:
            inside = (number, mark[1], [])
        elif mark and inside is not None:
            yield (*inside, comments)
            inside, comments = None, []
        elif inside is not None:
            inside[2].append(line)
        elif _COMMENT.match(line):
            comments.append(line)
        elif line.strip():
            comments = []


def blocks_of(page: str, text: str) -> Iterator[Block]:
    block, files = None, {}
    for number, language, lines, comments in fences(text):
        found = _COMMENT.findall('\n'.join(comments))
        if language == 'bash':
            block = Block(page=page, number=number, lines=lines, files=dict(files))
            for kind, value in found:
                if kind == 'small':
                    block.small = value
                else:
                    {'needs': block.needs, 'shows': block.shows, 'makes': block.makes}[
                        kind
                    ].append(value)
            yield block
        for kind, value in found:
            if kind == 'file':
                files[value] = '\n'.join(lines) + '\n'
            elif kind == 'printed':
                assert block is not None and language == 'text', f'{page}:{number}'
                block.printed = '\n'.join(lines)


TEXTS = {str(path.relative_to(ROOT)): path.read_text() for path in pages()}
#: a list: what stands below a block of lines may belong to it
BLOCKS = [block for page, text in TEXTS.items() for block in blocks_of(page, text)]


# --- checking -----------------------------------------------------------------------------------


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Parsers of `mtv-world`'s commands, of one word or two; none takes abbreviations here."""
    found = {}
    for name in COMMANDS:
        parser = make_parser(name)
        for word in name.split():
            (action,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
            parser = action.choices[word]
        parser.allow_abbrev = False
        found[name] = parser
    return found


def check(block: Block) -> None:
    """Fail where a line cannot be right."""
    for need in block.needs:
        assert need.split(' ')[0] in NEEDS, f"'{need}' is none of {list(NEEDS)}"
    for command in block.commands():
        program, *rest = command
        assert program in PROGRAMS, f'{program} is not known to this test'
        check_files(rest)
        runnable = PROGRAMS[program](rest)
        needed = [need for need in block.needs if NEEDS[need.split(' ')[0]] is None]
        assert runnable or needed, f"'{program}' is not run: say what it needs"


def check_files(words: Sequence[str]) -> None:
    """Files of the repository that are named must exist."""
    for word in words:
        name = word.removeprefix('src/mtv_world_ros/').removeprefix('$PWD/').split('=$PWD/')[-1]
        if name.split('/')[0] in FOLDERS and '/' in name:
            assert (ROOT / name).exists(), f'{name} does not exist'


def check_mtv_world(words: Sequence[str]) -> bool:
    if words[0] == '--help':
        return True
    known = parsers()
    name = next((n for n in (words[0], ' '.join(words[:2])) if n in known), '')
    assert name, f"'mtv-world {' '.join(words[:2])}' is none of {list(known)}"
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            arguments, more = known[name].parse_known_args(words[len(name.split()) :])
    except SystemExit as end:
        assert end.code == 0, said.getvalue()
        return True
    if more and getattr(arguments, 'takes_more', lambda *_: False)(arguments, more):
        source = PLAYER.read_text()
        more = [word for word in more if word.startswith('-') and f"'{word}'" not in source]
        more = [] if '--ros-args' in more else more
    assert not more, f'unrecognized arguments: {more}'
    try:
        check_values(vars(arguments))
    except MtvWorldError as error:
        pytest.fail(str(error))
    return True


def check_values(given: dict[str, Any]) -> None:
    """Raise a user error where a preset, policy, task ... does not exist."""
    from mtv_world_ros.cli.train import set_overrides
    from mtv_world_ros.model.serving import ServingOptions
    from mtv_world_ros.robot.file import robot_path
    from mtv_world_ros.simulation.faults.catalogue import parse_variant
    from mtv_world_ros.simulation.scenes.tasks import tasks_named
    from mtv_world_ros.simulation.zero_shot import kinds_named
    from mtv_world_ros.training.training_config import load_training_config
    from mtv_world_ros.vision.segmenters.registry import check_segmenter_name

    def each(names: str | Sequence[str]) -> list[str]:
        return names.split(',') if isinstance(names, str) else list(names)

    load_training_config(
        given.get('preset') or 'small', set_overrides(given.get('overrides') or [])
    )
    # those that begin so are the reader's own
    listed = [n for n in each(given.get('policies') or ()) if not n.startswith('my_')]
    assert all((ROOT / name).is_file() for name in listed if '/' in name)
    for name in [*listed, given.get('policy') or '']:
        if name.startswith('expert') or (name in listed and '/' not in name):
            parse_variant(name)
    for key in ('task', 'tasks'):
        # files are those that a page writes
        tasks_named(','.join(n for n in each(given.get(key) or ()) if not n.endswith('.yaml')))
    kinds_named(given.get('zero_shot') or '')
    ServingOptions.parse(given.get('serving') or '')
    check_segmenter_name(given.get('segmenter') or 'auto')
    if given.get('robot') and not given['robot'].startswith('my_'):  # those are the reader's own
        robot_path(given['robot'])


def check_world_model(words: Sequence[str]) -> bool:
    known = yaml.safe_load((ROOT / 'config' / 'node.yaml').read_text())['/**']['ros__parameters']
    names = [word.split(':=')[0] for word in words if ':=' in word]
    assert not [name for name in names if name not in known], f'no such parameter: {names}'
    options = {word for word in words if word.startswith('-')}
    assert options <= {'--ros-args', '-p', '--params-file'}, options
    return False


def check_policy_node(words: Sequence[str]) -> bool:
    pytest.importorskip('rclpy')
    from mtv_world_ros.ros.policy.loop import PolicySettings

    names = [word.split(':=')[0] for word in words if ':=' in word]
    unknown = [name for name in names if name not in PolicySettings.model_fields]
    assert not unknown, f'no such parameter: {unknown}'
    return False


def check_ros2(words: Sequence[str]) -> bool:
    if words[0] == 'launch':
        file = ROOT / 'launch' / words[2]
        assert file.is_file(), f'{file.name} is no launch file'
        source = file.read_text()
        for name in (word.split(':=')[0] for word in words[3:]):
            assert {f"'{name}'", f"'{name.replace('_', '-')}'"} & set(
                re.findall(r"'[\w-]+'", source)
            ), f'{file.name} has no argument {name}'
    elif words[0] == 'run':
        assert words[1] == 'mtv_world_ros'
        assert words[2] in ('mtv-world', 'world_model')
        PROGRAMS[words[2]](words[3:])
    elif words[0] == 'lifecycle':
        assert words[1:3] == ['set', '/world_model']
        assert words[3:] in (['configure'], ['activate'], ['deactivate'], ['cleanup'])
    elif words[0] == 'service':
        assert words[1:] == ['call', '/policy/start', 'std_srvs/srv/Trigger']
    else:
        assert words[:2] in (['bag', 'play'], ['bag', 'record'])
    return False


def check_python(words: Sequence[str]) -> bool:
    if words[:2] == ['-m', 'mtv_world_ros.cli']:
        return check_mtv_world(words[2:])
    if words[0] == '-m':
        module = words[1].split('.')
        exists = (ROOT.joinpath(*module[:-1]) / f'{module[-1]}.py').is_file()
        assert exists or module[0] != 'mtv_world_ros', f'there is no module {words[1]}'
        return False
    options = {word.split('=')[0] for word in words if word.startswith('--')}
    known = set(re.findall(r"'(--[\w-]+)'", _script_sources(ROOT / words[0])))
    assert options <= known, f'{words[0]} has no {options - known}'
    return words[0].startswith('examples/')


def _script_sources(script: Path) -> str:
    """The script and what its shared options come from."""
    shared = [*script.parent.glob('*.py'), *(ROOT / 'mtv_world_ros').glob('**/cli/*.py')]
    own = script.read_text()
    return own + '\n'.join(
        path.read_text() for path in shared if re.search(rf'from \S*{path.stem} import', own)
    )


def check_launcher(words: Sequence[str]) -> bool:
    at = list(words).index('-m')
    check_python(words[at:])
    return False


def check_make(words: Sequence[str]) -> bool:
    targets = re.findall(r'^([\w-]+):', (ROOT / 'Makefile').read_text(), re.M)
    assert set(words) <= set(targets), f'make has no target {set(words) - set(targets)}'
    return words == ['help']


PROGRAMS: dict[str, Callable[[Sequence[str]], bool]] = {
    'accelerate': check_launcher,
    'export': lambda words: '=' in words[0],
    'make': check_make,
    'mtv-world': check_mtv_world,
    'policy_node': check_policy_node,
    'python': check_python,
    'python3': lambda words: False,
    'ros2': check_ros2,
    'source': lambda words: list(words) == ['.venv/bin/activate'],
    'torchrun': check_launcher,
    'world_model': check_world_model,
    # of the system, or of others; never run
    **dict.fromkeys(
        (
            'apt',
            'cd',
            'cp',
            'git',
            'hf',
            'mkdir',
            'pip',
            'ray',
            'rosdep',
            'rviz2',
            'sed',
            'touch',
        ),
        lambda words: False,
    ),
}


@table('block', BLOCKS)
def test_lines_are_right(block):
    check(block)


@table(
    'text, message',
    [
        ('mtv-world train data/sim --out x --presett small', 'unrecognized arguments'),
        ('mtv-world train data/sim --out x --epis 3', 'unrecognized arguments'),
        ('mtv-world trian data/sim', 'is none of'),
        ('mtv-world train data/sim --out x --preset smal', "did you mean 'small'"),
        ('mtv-world train data/sim --out x --set optimizer.step=3', "did you mean 'steps'"),
        ('mtv-world collect --task stack_block --episodes 1 --out x', 'stack_block'),
        ('mtv-world collect --episodes 1 --policies expert-lat-0.3 --out x', 'lat'),
        ('mtv-world replay resource/demo_epsiode --offline', 'does not exist'),
        ('mtv-world replay resource/demo_episode --lockstep', 'unrecognized arguments'),
        ('mtv-world evaluate bundled x --out y --serving compil=true', 'compil'),
        ('python experiments/serving_speed.py --thread 2', 'has no'),
        ('python experiments/serving.py', 'does not exist'),
        ('python -m mtv_world_ros.ros.policy_node', 'there is no module'),
        ('world_model --ros-args -p modes:=imagine', 'no such parameter'),
        ('ros2 launch mtv_world_ros world_model.launch.py mod:=imagine', 'has no argument'),
        ('ros2 launch mtv_world_ros world.launch.py', 'is no launch file'),
        ('make dmeo', 'has no target'),
        ('git clone x', 'say what it needs'),
        ('curl x', 'is not known'),
    ],
)
def test_a_mistake_in_a_line_is_found(text, message):
    (block,) = blocks_of('page.md', f'Try it:\n\n```bash\n{text}\n```\n')
    with pytest.raises((AssertionError, pytest.fail.Exception), match=message):
        check(block)


def test_what_a_block_needs_must_be_a_known_word():
    (block,) = blocks_of('page.md', '<!-- needs: gpus -->\n```bash\nmake\n```\n')
    with pytest.raises(AssertionError, match="'gpus' is none of"):
        check(block)


@table('page', TEXTS)
def test_commands_stand_in_blocks_marked_bash(page):
    for number, language, lines, _ in fences(TEXTS[page]):
        assert language in LANGUAGES, f'{page}:{number}: a block of {language or "no language"}'
        # in a block of commands behind '$ ', other lines are answers
        shell = [line for line in lines if line.split(' ')[0] in PROGRAMS]
        shell = [] if lines[0].startswith('$ ') else shell
        assert language == 'bash' or not shell, f'{page}:{number}: {shell[0]}'
    indented = re.findall(r'^(?: {4}|\t)(?:mtv-world|ros2|make|python) .*$', TEXTS[page], re.M)
    assert not indented


@table('page', TEXTS)
def test_options_and_commands_in_the_text_exist(page):
    known = {option for parser in parsers().values() for option in parser._option_string_actions}
    shared = [PLAYER, *(ROOT / 'experiments').glob('*.py')]
    known |= {o for path in shared for o in re.findall(r"'(--[\w-]+)'", path.read_text())}
    for code in _CODE.findall(TEXTS[page]):
        words = code.split()
        if words[:1] == ['mtv-world'] and len(words) > 1 and re.fullmatch('[a-z]+', words[1]):
            assert words[1] in {name.split()[0] for name in COMMANDS}, code
        options = {word for word in re.findall(r'--[a-z][\w-]*', code) if words[0] != 'pip'}
        assert options <= known | FOREIGN_OPTIONS, code


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_stands_on_a_page(command):
    assert any(f'mtv-world {command}' in text for text in TEXTS.values())


# --- running ------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def workplace(tmp_path_factory) -> Iterator[Path]:
    """A folder with what the lines name of the repository; lines of later pages find in it what
    earlier ones made."""
    torch = pytest.importorskip('torch')
    folder = tmp_path_factory.mktemp('docs')
    for name in FOLDERS:
        if (ROOT / name).exists():
            (folder / name).symlink_to(ROOT / name)
    threads = torch.get_num_threads()
    yield folder
    torch.set_num_threads(threads)


def run(command: Sequence[str], small: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, *rest = command
    if program == 'mtv-world':
        try:
            status = main([*rest, *shlex.split(small)])
        except SystemExit as end:  # --help
            status = end.code
        assert status == 0, f'{shlex.join(command)}: exit status {status}'
    elif program == 'make':
        made = ['make', '-C', str(ROOT), *rest]
        print(subprocess.run(made, check=True, capture_output=True, text=True).stdout)
    elif program == 'export':
        name, _, value = rest[0].partition('=')
        value = value.replace('$PWD', str(Path.cwd()))
        monkeypatch.setenv(name, value)
        if name == 'PYTHONPATH':
            monkeypatch.syspath_prepend(value)
    elif program == 'python':
        monkeypatch.setattr(sys, 'argv', rest)
        runpy.run_path(rest[0], run_name='__main__')


@pytest.mark.slow
def test_lines_run_and_come_to_what_the_pages_say(workplace, monkeypatch, capsys):
    """In the order of the pages: a line may need what lines of earlier pages made."""
    done: dict[str, str] = {}
    wrong = []
    for block in BLOCKS:
        if block.obstacle():
            continue
        with monkeypatch.context() as patch:
            patch.chdir(workplace)
            for name, text in block.files.items():
                Path(name).write_text(text)
            try:
                check_outcome(block, printed_by(block, done, patch, capsys))
            except Exception:  # the other blocks are tried as well
                wrong.append(f'{block}\n{traceback.format_exc()}')
    assert not wrong, '\n\n'.join(wrong)


def printed_by(
    block: Block,
    done: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> str:
    """Run the lines of a block; those that another page has, too, are not run again.

    Args:
        block: of a page.
        done: what lines printed; lines that are run are added.
        monkeypatch: keeps the variables that lines export.
        capsys: has what lines print.
    """
    printed = ''
    for command in block.commands():
        line = shlex.join([*command, block.small])
        if command[0] == 'export' or line not in done:
            capsys.readouterr()
            run(command, block.small, monkeypatch)
            said = capsys.readouterr()
            done[line] = said.out + without_progress(said.err)
        printed += done[line]
    return printed


def without_progress(errors: str) -> str:
    """Return what was printed without lines that only a slow machine prints."""
    return re.sub(r'(?m)^(mtv-world: .*: loading|.*\d+ of \d+ .* left\b.*)\n', '', errors)


def check_outcome(block: Block, printed: str) -> None:
    """Fail where the page says something else."""
    for text in block.shows:
        assert is_like(printed, f'...{text}...'), f'{text}\n\nis not in\n\n{printed}'
    if block.printed:
        assert is_like(printed, block.printed), f'{printed}\n\nis not\n\n{block.printed}'
    for name in ' '.join(block.makes).split():
        assert list(Path().glob(name)), f'there is no {name}'
        assert all(path.is_dir() or path.stat().st_size for path in Path().glob(name)), name


def is_like(text: str, pattern: str) -> bool:
    """Whether a text is a pattern in which `...` is anything, whatever the spaces."""
    wanted = ' '.join(pattern.split()).replace('[', '[[]').replace('...', '*')
    wanted = wanted.replace('?', '[?]')
    return fnmatchcase(' '.join(text.split()), wanted)


def test_a_pattern_is_not_like_everything():
    assert is_like('rate: 1 of 1 = 1.00 [0.21 1.00]\n', 'rate: 1 of ... [0.21 1.00]')
    assert not is_like('rate: 0 of 1 = 0.00', 'rate: 1 of ...')
    assert not is_like('rate 1', 'rate ?') and not is_like('a b', 'a')


@table('block', [b for b in BLOCKS if not b.obstacle()])
def test_a_page_says_what_comes_of_lines_that_are_run(block):
    programs = {command[0] for command in block.commands()} - {'source', 'cd', 'export'}
    assert block.shows or block.makes or block.printed or not programs
