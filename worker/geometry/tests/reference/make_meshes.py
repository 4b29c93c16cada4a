"""Writes meshes/: one shape as other implementations save it, and its truth.

    pip install trimesh pygltflib meshio plyfile open3d
    python make_meshes.py

The shape has no symmetry, colours and normals. `truth.json` holds its triangles as corner positions and, for the
files that carry colours, each vertex's colour. Every file must give the same triangles.
"""

import json
import pathlib

import meshio
import numpy as np
import open3d
import plyfile
import pygltflib
import trimesh

OUT = pathlib.Path(__file__).parent / "meshes"
OUT.mkdir(exist_ok=True)

ball = trimesh.creation.icosphere(subdivisions=1)
p = ball.vertices.copy()
p = p * [1.0, 0.7, 1.3] + 0.2 * np.sin(3.0 * p[:, [1, 2, 0]]) + [3.0, -1.0, 2.0]
p = p.astype(np.float32).astype(np.float64)
faces = ball.faces.astype(np.uint32)
rng = np.random.default_rng(7)
colors = rng.integers(0, 256, (len(p), 3), dtype=np.uint8)
shape = trimesh.Trimesh(p, faces, process=False, vertex_colors=colors)
normals = shape.vertex_normals.astype(np.float32).astype(np.float64)
(OUT / "truth.json").write_text(json.dumps({"positions": p.tolist(), "triangles": faces.tolist(), "colors": colors.tolist()}))

# trimesh
shape.export(OUT / "trimesh_binary.ply")
shape.export(OUT / "trimesh_ascii.ply", encoding="ascii")
shape.export(OUT / "trimesh_binary.stl")
shape.export(OUT / "trimesh_ascii.stl", file_type="stl_ascii")
shape.export(OUT / "trimesh.obj")
shape.export(OUT / "trimesh.glb")
for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(shape)).items():
    name = name.replace("model.gltf", "trimesh.gltf")
    (OUT / name).write_bytes(data)

# Open3D
mesh = open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(p), open3d.utility.Vector3iVector(faces.astype(np.int32)))
mesh.vertex_colors = open3d.utility.Vector3dVector(colors / 255.0)
mesh.vertex_normals = open3d.utility.Vector3dVector(normals)
open3d.io.write_triangle_mesh(str(OUT / "open3d_ascii.ply"), mesh, write_ascii=True)
open3d.io.write_triangle_mesh(str(OUT / "open3d_binary.ply"), mesh)
open3d.io.write_triangle_mesh(str(OUT / "open3d.obj"), mesh)
open3d.io.write_triangle_mesh(str(OUT / "open3d.glb"), mesh)
mesh.compute_triangle_normals()
open3d.io.write_triangle_mesh(str(OUT / "open3d.stl"), mesh)

# meshio; its big binary STL header is free text
cells = [("triangle", faces.astype(np.int64))]
saved = meshio.Mesh(p, cells, point_data={"red": colors[:, 0], "green": colors[:, 1], "blue": colors[:, 2]})
meshio.write(OUT / "meshio_binary.ply", saved, binary=True)
meshio.write(OUT / "meshio_ascii.ply", saved, binary=False)
plain = meshio.Mesh(p, cells)
meshio.write(OUT / "meshio.obj", plain)
meshio.write(OUT / "meshio.stl", plain, binary=True)

# plyfile: big-endian, with float colours named as in some scanners' files and an element that means nothing to us
vertex = np.zeros(len(p), dtype=[(n, ">f8") for n in "xyz"] + [(f"diffuse_{c}", ">f4") for c in ("red", "green", "blue")])
for i, n in enumerate("xyz"):
    vertex[n] = p[:, i]
for i, c in enumerate(("red", "green", "blue")):
    vertex[f"diffuse_{c}"] = colors[:, i] / 255.0
face = np.zeros(len(faces), dtype=[("quality", ">f4"), ("vertex_indices", "O")])
face["vertex_indices"] = [f.astype(">u4") for f in faces]
camera = np.zeros(1, dtype=[("view", ">i2"), ("ids", "O")])
camera["ids"][0] = np.arange(5, dtype=">i4")
plyfile.PlyData(
    [
        plyfile.PlyElement.describe(camera, "camera", len_types={"ids": "u2"}, val_types={"ids": "i4"}),
        plyfile.PlyElement.describe(vertex, "vertex"),
        plyfile.PlyElement.describe(face, "face", len_types={"vertex_indices": "u1"}, val_types={"vertex_indices": "u4"}),
    ],
    byte_order=">",
).write(str(OUT / "plyfile_big_endian.ply"))

# pygltflib: the shape in five primitives on a tree of nodes: lists with 8-, 16- and 32-bit indices, a strip and a fan
# (each of them a few triangles long), positions partly by a sparse accessor, one mesh mirrored by its node.
root = trimesh.transformations.compose_matrix(angles=[0.3, -0.5, 0.9], translate=[10.0, -20.0, 30.0])
inner = np.diag([-2.0, 0.5, 3.0, 1.0])  # mirrors
inner[:3, 3] = [1.0, 2.0, 3.0]


def strip_from(faces):
    """Three triangles 0-1-2, 1-3-2, 2-3-4 that are in the shape, as a strip; and which faces they are."""
    edges = {}
    for i, f in enumerate(faces):
        for k in range(3):
            edges[(f[k], f[(k + 1) % 3])] = (i, f[(k + 2) % 3])
    a, b, c = faces[0]
    used, strip = [0], [a, b, c]
    while len(strip) < 7:
        # The next triangle lies across the edge of the last two vertices; which way it runs alternates.
        edge = (strip[-1], strip[-2]) if len(strip) % 2 else (strip[-2], strip[-1])
        i, d = edges[edge]
        used.append(i)
        strip.append(d)
    return strip, used


def fan_from(faces, skip):
    for hub in range(len(p)):
        around = {f[(k + 1) % 3]: (i, f[(k + 2) % 3]) for i, f in enumerate(faces) for k in range(3) if f[k] == hub}
        if any(i in skip for i, _ in around.values()):
            continue
        at = next(iter(around))
        fan, used = [hub, at], []
        for _ in range(len(around)):
            i, at = around[at]
            used.append(i)
            fan.append(at)
        return fan, used
    raise AssertionError


strip, in_strip = strip_from(faces)
fan, in_fan = fan_from(faces, set(in_strip))
rest = [f for i, f in enumerate(faces) if i not in set(in_strip) | set(in_fan)]
thirds = np.array_split(np.array(rest, dtype=np.uint32), 3)

blob = b""
gltf = pygltflib.GLTF2()


def view(data):
    global blob
    blob += b"\0" * (-len(blob) % 4)
    gltf.bufferViews.append(pygltflib.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(data)))
    blob += data
    return len(gltf.bufferViews) - 1


def accessor(**keys):
    gltf.accessors.append(pygltflib.Accessor(**keys))
    return len(gltf.accessors) - 1


def positions(matrix, sparse):
    back = np.linalg.inv(matrix)
    local = (p @ back[:3, :3].T + back[:3, 3]).astype(np.float32)
    base = local.copy()
    extra = None
    if sparse:
        ids = np.array([2, 5, 11], dtype=np.uint16)
        base[ids] = 0
        extra = pygltflib.Sparse(
            count=3,
            indices=pygltflib.AccessorSparseIndices(bufferView=view(ids.tobytes()), componentType=5123),
            values=pygltflib.AccessorSparseValues(bufferView=view(local[ids].tobytes())),
        )
    return accessor(
        bufferView=view(base.tobytes()), componentType=5126, count=len(local), type="VEC3", sparse=extra,
        min=local.min(0).tolist(), max=local.max(0).tolist(),
    )


linear = np.where(colors / 255.0 <= 0.04045, colors / 255.0 / 12.92, ((colors / 255.0 + 0.055) / 1.055) ** 2.4)
color = accessor(bufferView=view(linear.astype(np.float32).tobytes()), componentType=5126, count=len(p), type="VEC3")
outer_position, inner_position = positions(root, False), positions(root @ inner, True)


def primitive(indices, dtype, code, mode, position, flip=False):
    indices = np.asarray(indices)
    if flip:
        indices = indices[:, ::-1]
    data = indices.astype(dtype).tobytes()
    index = accessor(bufferView=view(data), componentType=code, count=indices.size, type="SCALAR")
    return pygltflib.Primitive(attributes=pygltflib.Attributes(POSITION=position, COLOR_0=color), indices=index, mode=mode)


gltf.meshes = [
    pygltflib.Mesh(primitives=[
        primitive(thirds[0], np.uint8, 5121, 4, outer_position),
        primitive(strip, np.uint16, 5123, 5, outer_position),
        primitive(fan, np.uint8, 5121, 6, outer_position),
        primitive([0, 1], np.uint8, 5121, 1, outer_position),
    ]),
    pygltflib.Mesh(primitives=[
        primitive(thirds[1], np.uint16, 5123, 4, inner_position, flip=True),
        primitive(thirds[2], np.uint32, 5125, 4, inner_position, flip=True),
    ]),
]
quaternion = trimesh.transformations.quaternion_from_matrix(root)
gltf.nodes = [
    pygltflib.Node(children=[1], mesh=0, translation=root[:3, 3].tolist(), rotation=[float(quaternion[i]) for i in (1, 2, 3, 0)]),
    pygltflib.Node(mesh=1, matrix=inner.T.reshape(-1).tolist()),
    pygltflib.Node(mesh=0, translation=[100.0, 0.0, 0.0]),
]
# The third node is in no scene and must not appear.
gltf.scenes, gltf.scene = [pygltflib.Scene(nodes=[0])], 0
gltf.buffers = [pygltflib.Buffer(byteLength=len(blob))]
gltf.set_binary_blob(blob)
gltf.save_binary(str(OUT / "pygltflib.glb"))
gltf.convert_buffers(pygltflib.BufferFormat.DATAURI)
gltf.save(str(OUT / "pygltflib.gltf"))
