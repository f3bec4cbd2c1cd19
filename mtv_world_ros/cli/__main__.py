"""`python -m mtv_world_ros.cli`."""

import sys

from mtv_world_ros.cli import main

sys.exit(main())
