#!/usr/bin/env bash
# diffusers 0.42.1: a flow model sampled with DEIS keeps a seventh of the noise in its videos.
#
# Wan's schedule (UniPCMultistepScheduler, use_flow_sigmas, flow_shift 3) is given to other
# samplers by from_config, the library's way to change samplers. Expected of each: noise levels
# that end at 0, so that a model whose velocity is noise - video, the same everywhere, gives back
# the video. What happens: UniPC and DPM++ do; DEIS does not hear of final_sigmas_type="zero" and
# repeats its last level instead (.136 of 20 steps, .75 of 2), so that the video comes back with
# that much of the noise, without a word.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check diffusers==0.42.1 torch==2.13.0 \
    numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import diffusers
import torch

WAN = diffusers.UniPCMultistepScheduler(
    use_flow_sigmas=True, flow_shift=3.0, prediction_type='flow_prediction', final_sigmas_type='zero'
)
video, noise = torch.randn(2, 1, 4, 8, 8, 8, generator=torch.Generator().manual_seed(0))


def sample(name, steps):
    scheduler = getattr(diffusers, name).from_config(WAN.config)
    assert scheduler.config.final_sigmas_type == 'zero' and scheduler.config.use_flow_sigmas
    scheduler.set_timesteps(steps)
    level = scheduler.sigmas[0]
    latents = (1 - level) * video + level * noise
    for time in scheduler.timesteps:
        latents = scheduler.step(noise - video, time, latents).prev_sample
    left = (latents - video) / (noise - video)  # the share of the noise, the same everywhere
    return float(scheduler.sigmas[-1]), float(left.median())


for name in ('UniPCMultistepScheduler', 'DPMSolverMultistepScheduler', 'DEISMultistepScheduler'):
    for steps in (2, 20):
        last, left = sample(name, steps)
        print(f'{name}, {steps} steps: last noise level {last:.3f}, noise left {left:.3f}')
        if name.startswith('DEIS'):
            assert left > (0.7 if steps == 2 else 0.1), 'changed: DEIS'
            assert abs(left - last) < 1e-3, 'changed: DEIS'
        else:
            assert abs(left) < 1e-4 and last == 0, f'changed: {name}'
PYTHON
