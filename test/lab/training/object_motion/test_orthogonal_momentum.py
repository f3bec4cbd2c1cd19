import pytest
import torch

from mtv_world_ros.lab.training.object_motion.orthogonal_momentum import OrthogonalMomentum


@pytest.mark.parametrize('shape', [(12, 30), (30, 12)])
def test_it_steps_along_the_nearest_orthogonal_matrix_in_float32(shape):
    torch.manual_seed(0)
    U, _, Vh = torch.linalg.svd(torch.randn(*shape), full_matrices=False)
    gradient = U @ torch.diag(torch.linspace(0.3, 1.0, 12)) @ Vh
    weight = torch.nn.Parameter(torch.zeros(*shape))
    weight.grad = gradient.clone()
    plain, own = (
        torch.optim.Muon([weight], lr=1.0, weight_decay=0.1, adjust_lr_fn='match_rms_adamw'),
        torch.nn.Parameter(weight.clone()),
    )
    own.grad = gradient.clone()
    OrthogonalMomentum([own], lr=1.0, weight_decay=0.1).step()
    plain.step()
    # torch's is off by what bfloat16 rounds
    assert 0 < (own - weight).norm() < 0.02 * weight.norm()
    # -U V^T but for the sizes of its singular values, which stay near one
    sizes = -(U.T @ own.detach() @ Vh.T)
    off = sizes - torch.diag(sizes.diagonal())
    assert off.abs().max() < 1e-4 and (sizes.diagonal() / sizes.diagonal().mean()).min() > 0.6


def test_momentum_and_weight_decay_are_those_of_torch_also_under_a_schedule():
    torch.manual_seed(0)
    weights = [torch.nn.Parameter(torch.randn(16, 40)) for _ in range(2)]
    weights[1].data.copy_(weights[0].data)
    optimisers = [
        torch.optim.Muon(weights[:1], lr=0.1, weight_decay=0.1, adjust_lr_fn='match_rms_adamw'),
        OrthogonalMomentum(weights[1:], lr=0.1, weight_decay=0.1),
    ]
    schedules = [torch.optim.lr_scheduler.ExponentialLR(o, 0.8) for o in optimisers]
    begun = weights[0].detach().clone()
    for _ in range(10):
        gradient = torch.randn(16, 40)
        for weight, optimiser, schedule in zip(weights, optimisers, schedules, strict=True):
            weight.grad = gradient.clone()
            optimiser.step()
            schedule.step()
    # torch's is off by what bfloat16 rounds
    assert (weights[1] - weights[0]).norm() < 0.02 * (weights[0] - begun).norm()
