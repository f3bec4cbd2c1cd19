"""The running node exchanges LoRA adapters between rollouts, and refuses those that do not fit."""

import numpy as np
import pytest
from sensor_msgs.msg import Image
import torch

from mtv_world_ros.model.autoencoders import SpaceToDepthAutoencoder
from mtv_world_ros.model.parts import build_scheduler
from mtv_world_ros.model.trained_model import save_trained_model, TrainedModel
from mtv_world_ros.model.transformer.transformer import MultiViewWanTransformer
from mtv_world_ros.ros.messages.image_messages import to_rgb
from mtv_world_ros.ros.world_model.loading import load_named_pipeline
from mtv_world_ros.training.adapter import add_adapter, save_adapter
from mtv_world_ros.training.training_config import load_training_config

FRAMES, CHUNKS = 4, 3
TOPICS = {f'/world_model/{view}/predicted/image_raw': Image for view in ('low', 'high')}


def make_transformer(**changes):
    config = load_training_config('small').transformer
    torch.manual_seed(0)
    model = MultiViewWanTransformer(
        **{
            **config,
            'num_attention_heads': 2,
            'attention_head_dim': 12,
            'ffn_dim': 32,
            'num_layers': 1,
            'stem_widths': (8, 16, 16),
            'freq_dim': 16,
            **changes,
        }
    )
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


def save_trained(folder, **changes):
    model = make_transformer(**changes)
    add_adapter(model, rank=2)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter.add_(0.5 * torch.randn_like(parameter))
    save_adapter(model, folder)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A checkpoint, an adapter for it, one for another model, and what is none."""
    root = tmp_path_factory.mktemp('adapter')
    video = {'width': 48, 'height': 40, 'fps': 5.0, 'num_frames': FRAMES}
    config = load_training_config('small', {f'video.{k}': v for k, v in video.items()})
    parts = TrainedModel(
        transformer=make_transformer(),
        autoencoder=SpaceToDepthAutoencoder(),
        scheduler=build_scheduler(config.scheduler),
        card=config.card({}),
    )
    save_trained_model(parts, root / 'checkpoint')
    save_trained(root / 'mine')
    save_trained(root / 'deeper', num_layers=2)
    (root / 'empty').mkdir()
    return root


@pytest.fixture(scope='module')
def node(folder, ros, client, tmp_path_factory):
    values = (
        f'checkpoint:={folder / "checkpoint"}',
        'pace:=burst',
        'num_inference_steps:=1',
        'diagnostics_period_s:=0.1',
        'max_image_age_s:=30.0',
        'max_joint_state_age_s:=30.0',
    )
    process = ros.start_node(folder, *values, load=load_named_pipeline)
    for topic in TOPICS:
        client.wait(lambda t=topic: client.node.count_publishers(t), 'the node', 120)
    client.connect_outputs(TOPICS, depth=FRAMES * CHUNKS)
    client.connect_inputs(ros.INPUTS)
    client.send_scene()
    yield process
    assert process.stop() == 0, process.output()


def imagined(client):
    """The last rollout's frames of all views, as one array."""
    client.wait_for_all(TOPICS)
    return np.stack([[to_rgb(image) for image in client.received[t]] for t in TOPICS])


def roll_out(client, seconds=0.8):
    for topic in TOPICS:
        client.received[topic].clear()
    assert client.imagine_one(scene='sent', seconds=seconds)['state'] == 'done'
    return imagined(client)


def use(client, value):
    """Set the parameter and wait until it holds."""
    assert client.set(adapter=str(value)) == ''
    wait_for(client, str(value))


def wait_for(client, value):
    client.received['/diagnostics'].clear()
    client.wait(lambda: client.diagnostic_values().get('adapter') == value, f'adapter {value}')


@pytest.mark.slow
def test_adapters_are_taken_and_left_while_the_node_runs(node, client, folder):
    plain = roll_out(client)
    use(client, folder / 'mine')
    adapted = roll_out(client)
    assert np.abs(adapted.astype(int) - plain).max() > 2
    for without in ('', 'none'):  # this checkpoint has none of its own
        use(client, without)
        np.testing.assert_array_equal(roll_out(client), plain)


@pytest.mark.parametrize(
    ('name', 'reason'),
    [
        ('nowhere', 'is no adapter: expected a folder with'),
        ('empty', 'is no adapter: expected a folder with'),
        ('deeper', 'was trained on a transformer of num_layers 2, this one has 1'),
    ],
)
def test_what_does_not_fit_is_refused_and_the_old_one_stays(node, client, folder, name, reason):
    use(client, folder / 'mine')
    before = roll_out(client)
    said = client.set(adapter=str(folder / name))
    wait_for(client, str(folder / 'mine'))
    assert reason in said and str(folder / name) in said
    np.testing.assert_array_equal(roll_out(client), before)
    assert client.get('adapter') == str(folder / 'mine')


def test_a_running_rollout_ends_with_the_adapter_that_it_began_with(node, client, folder):
    use(client, '')
    client.set(num_inference_steps=30)
    seconds = 0.8 * CHUNKS
    plain = roll_out(client, seconds)
    for topic in TOPICS:
        client.received[topic].clear()
    since = len(client.report_values())
    client.send_trajectory(seconds=seconds)
    client.wait(lambda: _first_chunk(client, since), 'the first chunk')
    assert client.set(adapter=str(folder / 'mine')) == ''
    states = {values['state'] for values in client.report_values()[since:]}
    assert states <= {'foreseen', 'chunk', 'published'}  # it was set in the middle
    assert client.next_end(since)['state'] == 'done'
    np.testing.assert_array_equal(imagined(client), plain)
    assert np.abs(roll_out(client, seconds).astype(int) - plain).max() > 2
    client.set(num_inference_steps=1)


def _first_chunk(client, since):
    return any(values['state'] == 'chunk' for values in client.report_values()[since:])
