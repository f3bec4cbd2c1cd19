"""What a step takes: counted on shapes, against a step that is really computed."""

import pytest
import torch

from mtv_world_ros.cli import main
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.training.dry_run import step_cost
from mtv_world_ros.training.training_config import load_training_config
from test.support.sources import TINY_MODEL


def test_counts_what_a_real_step_does():
    config = load_training_config('small', TINY_MODEL)
    fake = step_cost(config, dtype=torch.float32)
    assert fake == step_cost(config, dtype=torch.float32, fake=False)
    model = MultiViewWanTransformer(**config.transformer)
    assert fake.parameters == fake.trainable == sum(p.numel() for p in model.parameters())
    # float32 weights twice; averaged weights, Adam's two moments, gradients twice
    assert fake.weight_bytes + fake.training_bytes == fake.parameters * 4 * (2 + 5)


@pytest.mark.parametrize('rank', [0, 8])
def test_operations_are_those_of_the_products(rank):
    """Of a patch model: every product of matrices in the published block, counted by hand."""
    config = load_training_config(
        'wan-1.3b',
        {
            'transformer.num_layers': 1,
            'video.width': 64,
            'video.height': 32,
            'video.num_frames': 8,
            'optimizer.batch_size': 1,
            'optimizer.gradient_checkpointing': False,
            'lora.rank': rank,
        },
    )
    cost = step_cost(config, dtype=torch.bfloat16)
    dim, ffn, text, image = 1536, 8960, 512, 2 * 257
    grid = 3 * 4 * 8  # latent frames, height, width of a view
    kept = 2 * grid // 4
    history = 2 * 2 * (4 * 8) // 4  # the last five frames are two latent ones
    reference = 2 * (4 * 8) // 4
    tokens = history + reference + kept
    block = tokens * dim * (4 * dim + 2 * dim + 2 * ffn)  # self, query and output, feed forward
    block += 2 * (text + image) * dim * dim  # keys and values of the context
    block += 2 * tokens * dim * (tokens + text + image)  # attention: weights, values
    embedded = reference * 4 * 16 * dim + (history + kept) * 4 * 48 * dim + kept * dim * 64
    text_embedder = text * (4096 * dim + dim * dim)
    image_embedder = image * (1280 * 1280 + 1280 * dim)
    time = 2 * (256 * dim + dim * dim + dim * 6 * dim)  # of the video and of the history
    # an adapter's factors: to `rank` numbers and back, of tokens and of the text
    factors = tokens * rank * (6 * 2 * dim + 2 * (dim + ffn)) + 2 * text * rank * 2 * dim
    expected = 2 * (block + embedded + text_embedder + image_embedder + time + factors)
    assert cost.forward_flop == expected
    if rank:
        trained = 8 * rank * 2 * dim + 2 * rank * (dim + ffn)
        trained += dim * (4 * 16 + 1) + dim * (4 * 48 + 1) + 2 * dim  # phi, patches, views
        assert cost.trainable == trained
        # bfloat16 weights and gradients; float32 ones, averages and Adam's moments of the trained
        assert cost.weight_bytes == 2 * cost.parameters + 4 * trained
        assert cost.training_bytes == (4 * 4 + 2) * trained


def test_the_command_prints_it_and_trains_nothing(capsys):
    smaller = ['--set', 'transformer.num_layers=1', '--set', 'video.num_frames=4']
    assert main(['train', '--dry-run', *smaller]) == 0
    printed = capsys.readouterr().out
    assert '2 views of 5 frames of 96x72' in printed
    for word in ('parameters', 'trainable', 'TFLOP', 'memory', 'activations'):
        assert word in printed
