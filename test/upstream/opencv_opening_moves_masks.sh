#!/usr/bin/env bash
# opencv-python-headless 5.0.0.93: opening or closing a mask with a 2 x 2 kernel moves it by a pixel.
#
# Expected of cv2.morphologyEx(MORPH_OPEN), by the definition of an opening: nothing is set outside
# of the mask, and a square of 4 x 4 pixels stays as it is, as scipy's binary_opening leaves it. What
# happens: both steps use the same anchor, so that the square comes back one pixel to the lower
# right, 7 of 16 pixels outside of where it was. erode and dilate with anchors (0, 0) and (1, 1) give
# the opening.
#
# Guards mtv_world_ros/vision/segmenters/examples.py, which opens masks by erode and dilate with
# two anchors.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.4.6 scipy==1.17.1
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import cv2
import numpy as np
from scipy import ndimage

mask = np.zeros((10, 10), np.uint8)
mask[3:7, 3:7] = 1
square = np.ones((2, 2), np.uint8)
opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, square)
closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, square)
apart = cv2.dilate(cv2.erode(mask, square, anchor=(0, 0)), square, anchor=(1, 1))
for name, found in (('opened', opened), ('closed', closed), ('with two anchors', apart)):
    rows, columns = np.nonzero(found)
    print(f'{name}: rows {rows.min()} to {rows.max()}, columns {columns.min()} to '
          f'{columns.max()}, {np.count_nonzero(found & ~mask & 1)} pixels outside of the mask')
assert (ndimage.binary_opening(mask, square) == mask).all(), 'scipy changed'
assert (apart == mask).all(), 'changed'
if not (opened & ~mask & 1).any():
    raise SystemExit('changed: an opening stays inside of the mask')
PYTHON
