from pathlib import Path

import pytest

from test.support.tiny_vision import save_dino, save_sam2, save_sam3


@pytest.fixture(scope='session')
def weights(tmp_path_factory) -> Path:
    """A folder with one tiny model of each kind, in subfolders of arbitrary names."""
    # test/upstream/transformers_sam2_video_config.sh: up to 5.19 SAM 2's settings are misread
    pytest.importorskip('transformers', '5.20')
    root = tmp_path_factory.mktemp('weights')
    save_dino(root / 'some org' / 'detector')
    save_sam2(root / 'tracker')
    save_sam3(root / 'third')
    return root
