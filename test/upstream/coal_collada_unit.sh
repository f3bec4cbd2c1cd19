#!/usr/bin/env bash
# The unit of a COLLADA file in three readers of meshes: a box of 0.06 x 0.06 x 0.3 m in inches.
#
# COLLADA 1.4.1 says that <asset><unit meter> is the length of the file's unit. Expected, written
# down before the run: extents of .06, .06 and .3. What happens: trimesh 4.7.1 keeps the unit apart
# and converts when it is asked to; Coal 3.0.3, which Pinocchio loads meshes with, returns
# 2.36 x 2.36 x 11.8 without a word. Guards: load_mesh, which applies the unit.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/env"
"$place/env/bin/pip" install -q --disable-pip-version-check coal==3.0.3 trimesh==4.7.1 \
    pycollada==0.9.2 numpy==2.4.6
cd "$place"
"$place/env/bin/python" - <<'PYTHON'
import coal
import numpy as np
import trimesh

SIZE = np.array([0.06, 0.06, 0.3])
signs = [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
numbers = ' '.join(f'{v:.6f}' for v in (np.array(signs) * SIZE / 0.0254).ravel())
faces = '0 1 3 0 3 2 4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3'
with open('box.dae', 'w') as file:
    file.write(f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="inch" meter="0.0254"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g" name="g"><mesh><source id="p">
<float_array id="pa" count="24">{numbers}</float_array><technique_common>
<accessor source="#pa" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles>
</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">
<node id="n"><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>""")

scene = trimesh.load('box.dae', force='scene')
of_trimesh = scene.convert_units('meters').extents
of_coal = np.ptp(coal.MeshLoader().load('box.dae', np.ones(3)).vertices(), axis=0)
print('trimesh, in metres:', of_trimesh.round(4).tolist())
print('Coal:              ', of_coal.round(4).tolist())
assert np.allclose(of_trimesh, SIZE, atol=1e-4), 'changed: trimesh'
assert np.allclose(of_coal, SIZE / 0.0254, atol=1e-3), 'changed: Coal'
PYTHON
