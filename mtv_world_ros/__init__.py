"""An online embodied world model for ROS 2: trajectory in, imagined camera streams out."""

import os

# Threads of torch that wait for one another sleep. By default they spin: where another process
# takes a core, those that wait use up the time that the last one needs, and all is many times as
# slow (`benchmark/busy_cores.py`). The library reads this as it is loaded.
os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
