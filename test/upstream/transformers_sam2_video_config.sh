#!/usr/bin/env bash
# A SAM 2 video configuration saved and loaded again by transformers, of six releases of one major.
#
# Expected, written down before the run: what save_pretrained writes, from_pretrained reads as the
# same classes. What happens: from 5.16.0 to 5.19.0 the mask decoder's part comes back as the
# prompt encoder's class, without a word; the model that is built from it then lacks a number of
# masks. The image model's configuration (Sam2Config) comes back whole in all of them, and the
# video one from 5.20.0 on.
#
# Guards the bound transformers>=5.23 of the extra `vision` in setup.py.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
for version in 5.16.0 5.19.0 5.20.0; do
    python3 -m venv "$place/$version"
    "$place/$version/bin/pip" install -q --disable-pip-version-check "transformers==$version"
    "$place/$version/bin/python" - <<'PYTHON'
import tempfile

from transformers import __version__, Sam2Config, Sam2VideoConfig

OLD = __version__ in ('5.16.0', '5.19.0')
found = {}
for kind in (Sam2Config, Sam2VideoConfig):
    with tempfile.TemporaryDirectory() as folder:
        kind().save_pretrained(folder)
        read = kind.from_pretrained(folder).mask_decoder_config
    found[kind.__name__] = type(read).__name__
    masks = getattr(read, 'num_multimask_outputs', 'no number of masks')
    print(__version__, kind.__name__, '->', type(read).__name__, masks)
assert found['Sam2Config'] == 'Sam2MaskDecoderConfig', 'changed: the image model'
wanted = 'Sam2VideoPromptEncoderConfig' if OLD else 'Sam2VideoMaskDecoderConfig'
assert found['Sam2VideoConfig'] == wanted, f'changed: {__version__}'
PYTHON
done
