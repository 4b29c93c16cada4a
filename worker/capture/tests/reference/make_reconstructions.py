#!/usr/bin/env python3
"""Writes one small scene in every format of reconstructions, with pixels as other implementations see them.

    python -m venv /tmp/venv && /tmp/venv/bin/pip install pycolmap==4.2.1 numpy pillow pyquaternion numpy-quaternion tqdm rich requests \
        appdirs packaging setuptools
    /tmp/venv/bin/pip install --no-deps nerfstudio==1.1.5 easyidp==2.0.4 camorph==1.0.0 kapture==1.1.12
    /tmp/venv/bin/python make_reconstructions.py

Each folder under reconstructions/ holds the files of cameras as they lie in a capture, and `projections.txt`, one
line per observation:
    IMAGE_NAME X Y Z PX PY
with a point of the world and its pixel. Who wrote the files and who judged the pixels stands at each function; what
nobody else computes follows the vendor's documented formula, in numpy. The poses are the same in all folders but
those of rigs. The script is seeded: running it again writes the same files.

nerfstudio, easyidp, camorph and kapture are called only where they need no more than numpy; their heavier imports are replaced.
"""
import importlib
import importlib.util
import json
import shutil
import sys
import tempfile
import types
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pycolmap
from PIL import Image

OUT = Path(__file__).parent / "reconstructions"
W, H = 96, 70
# Asymmetric on purpose: sizes, principal point, rotations and lens are all general.
F, CX, CY = 88.0, 45.5, 37.25
K1, K2, P1, P2 = -0.18, 0.06, 0.004, -0.007
NAMES = [f"photo_{index}.png" for index in range(1, 6)]
FLIP = np.diag([1.0, -1.0, -1.0])


def stand_in_for_heavy_imports() -> None:
    class Tensor(np.ndarray):
        def float(self):
            return self.astype(np.float32)

    torch = MagicMock()
    torch.Tensor = Tensor
    torch.from_numpy = lambda array: array.view(Tensor)
    torch.einsum = np.einsum
    sys.modules["torch"] = torch
    for name in ["rdflib", "yaml", "mpl_toolkits", "mpl_toolkits.mplot3d", "matplotlib.pyplot", "cv2", "open3d", "imageio", "rawpy", "matplotlib", "nerfstudio.utils.colormaps", "nerfstudio.utils.scripts"]:
        sys.modules[name] = MagicMock()
    distutils = types.ModuleType("distutils.version")
    distutils.StrictVersion = lambda text: tuple(int(part) for part in text.split("."))
    sys.modules["distutils.version"] = distutils


def scene() -> tuple[dict, np.ndarray, np.ndarray]:
    """Poses (camera from world, COLMAP's axes) by name, points and their colours."""
    rng = np.random.default_rng(7)
    poses = {}
    for name in NAMES:
        quaternion = rng.normal(size=4)
        rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
        translation = np.array([0.0, 0.0, 4.0]) + rng.uniform(-0.3, 0.3, size=3)
        poses[name] = pycolmap.Rigid3d(rotation, translation)
    points = rng.uniform(-0.9, 0.9, size=(10, 3))
    return poses, points, rng.integers(0, 256, size=(10, 3)).astype(np.uint8)


POSES, POINTS, COLORS = scene()


def matrix(pose: pycolmap.Rigid3d) -> np.ndarray:
    return np.vstack([pose.matrix(), [0.0, 0.0, 0.0, 1.0]])


def camera(model: str, params: list[float], camera_id: int = 1) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=camera_id, model=model, width=W, height=H, params=params)


LENS = camera("OPENCV", [F, F, CX, CY, K1, K2, P1, P2])
CENTERED = camera("RADIAL", [F, W / 2, H / 2, K1, K2])


def by_pycolmap(lens: pycolmap.Camera):
    return lambda in_camera: lens.img_from_cam(in_camera)


def folder(name: str) -> Path:
    path = OUT / name
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    return path


def write_projections(path: Path, project, poses: dict = POSES) -> None:
    """`project` takes a point in camera axes (x right, y down, z forward) to its pixel."""
    with open(path / "projections.txt", "w") as file:
        for name, pose in poses.items():
            for point in POINTS:
                numbers = " ".join(f"{value:.17g}" for value in [*point, *project(pose * point)])
                file.write(f"{name} {numbers}\n")


def colmap_model(lens: pycolmap.Camera) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(lens)
    observed = {index: [] for index in range(len(POINTS))}
    for image_id, name in enumerate(NAMES, 1):
        pixels = [lens.img_from_cam(POSES[name] * point) for point in POINTS]
        for index in observed:
            observed[index].append((image_id, index))
        image = pycolmap.Image(image_id=image_id, name=name, camera_id=1, keypoints=np.array(pixels))
        model.add_image_with_trivial_frame(image, POSES[name])
    for index, point in enumerate(POINTS):
        track = pycolmap.Track([pycolmap.TrackElement(*element) for element in observed[index]])
        model.add_point3D(point, track, COLORS[index])
    return model


def colmap() -> None:
    """Written and judged by pycolmap, with rigs and frames beside the model."""
    path = folder("colmap")
    (path / "sparse/0").mkdir(parents=True)
    colmap_model(LENS).write_text(path / "sparse/0")
    write_projections(path, by_pycolmap(LENS))


def colmap_rig() -> None:
    """A rig of two cameras at three times: written by pycolmap, which composes the images' poses."""
    path = folder("colmap_rig")
    (path / "sparse/0").mkdir(parents=True)
    lenses = {1: LENS, 2: camera("PINHOLE", [80.0, 84.0, 50.0, 33.0], 2)}
    rng = np.random.default_rng(3)
    quaternion = np.array([0.05, -0.12, 0.03, 1.0])
    sensor_from_rig = pycolmap.Rigid3d(
        pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion)), np.array([0.4, -0.1, 0.05])
    )
    sensors = {key: pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=key) for key in lenses}
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(sensors[1])
    rig.add_sensor(sensors[2], sensor_from_rig)
    model = pycolmap.Reconstruction()
    for lens in lenses.values():
        model.add_camera(lens)
    model.add_rig(rig)
    poses, pixels = {}, {}
    for index, name in enumerate(NAMES[:3]):
        frame = pycolmap.Frame(frame_id=index + 1, rig_id=1, rig_from_world=POSES[name])
        ids = {key: 2 * index + key for key in lenses}
        for key, image_id in ids.items():
            frame.add_data_id(pycolmap.data_t(sensor_id=sensors[key], id=image_id))
        model.add_frame(frame)
        for key, image_id in ids.items():
            image = pycolmap.Image(
                image_id=image_id, name=f"camera_{key}/{name}", camera_id=key,
                keypoints=rng.uniform(0, 60, size=(2, 2)),
            )
            image.frame_id = index + 1
            model.add_image(image)
        model.register_frame(index + 1)
    for image in model.images.values():
        poses[image.name] = image.cam_from_world()
        pixels[image.name] = lenses[image.camera_id]
    model.write_binary(path / "sparse/0")
    with open(path / "projections.txt", "w") as file:
        for name, pose in poses.items():
            for point in POINTS:
                pixel = pixels[name].img_from_cam(pose * point)
                file.write(f"{name} " + " ".join(f"{v:.17g}" for v in [*point, *pixel]) + "\n")


def transforms_nerfstudio() -> None:
    """Converted by nerfstudio from a COLMAP model: one lens at the top, applied_transform, points. Judged by pycolmap."""
    from nerfstudio.process_data import colmap_utils

    for name, lens in [
        ("transforms_opencv", LENS),
        ("transforms_fisheye", camera("OPENCV_FISHEYE", [F, 92.5, CX, CY, -0.05, 0.02, -0.01, 0.003])),
    ]:
        path = folder(name)
        with tempfile.TemporaryDirectory() as model:
            colmap_model(lens).write_binary(model)
            colmap_utils.colmap_to_json(Path(model), path)
        write_projections(path, by_pycolmap(lens))


def transforms_ngp() -> None:
    """After instant-ngp's documented keys: angle in place of focal length, names without endings, box of its own."""
    path = folder("transforms_ngp")
    frames = [
        {
            "file_path": f"./images/{Path(name).stem}",
            "sharpness": 30.0,
            "transform_matrix": (np.linalg.inv(matrix(pose)) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        for name, pose in POSES.items()
    ]
    # The last frame has a lens of its own.
    frames[-1] |= {"fl_x": 100.0, "cx": 40.0}
    angle = 2 * np.arctan(0.5 * W / F)
    top = {
        "camera_angle_x": angle, "w": float(W), "h": float(H), "cx": CX, "cy": CY,
        "k1": K1, "k2": K2, "p1": P1, "p2": P2, "aabb_scale": 4, "scale": 0.5, "offset": [0.1, 0.2, 0.3],
    }
    (path / "transforms.json").write_text(json.dumps(top | {"frames": frames}, indent=1))
    last = camera("OPENCV", [100.0, 100.0, 40.0, CY, K1, K2, P1, P2])
    with open(path / "projections.txt", "w") as file:
        for name, pose in POSES.items():
            lens = last if name == NAMES[-1] else LENS
            for point in POINTS:
                numbers = [*point, *lens.img_from_cam(pose * point)]
                file.write(f"{name} " + " ".join(f"{v:.17g}" for v in numbers) + "\n")


def transforms_scaled() -> None:
    """The converted COLMAP file of above, enlarged by 0.4 after its applied_transform. nerfstudio's own
    transform_poses_to_original_space, which undoes both, gives the poses; the lens is judged by pycolmap."""
    converted = json.loads((OUT / "transforms_opencv/transforms.json").read_text())
    scale = 0.4
    poses, originals = {}, np.linalg.inv(np.vstack([converted["applied_transform"], [0, 0, 0, 1]]))
    for frame in converted["frames"]:
        saved = np.array(frame["transform_matrix"])
        saved[:3, 3] *= scale
        frame["transform_matrix"] = saved.tolist()
        # base_dataparser.py, transform_poses_to_original_space: centres are divided, then moved back, then turned to OpenCV's axes.
        original = saved.copy()
        original[:3, 3] /= scale
        original = originals @ original
        original[:3, 1:3] *= -1
        poses[Path(frame["file_path"]).name] = pycolmap.Rigid3d(np.linalg.inv(original)[:3])
    path = folder("transforms_scaled")
    converted["applied_scale"] = scale
    del converted["ply_file_path"]
    (path / "transforms.json").write_text(json.dumps(converted, indent=1))
    write_projections(path, by_pycolmap(LENS), {name: poses[name] for name in NAMES})


def fisheye624(params: list[float]):
    """Project Aria's FisheyeRadTanThinPrism, after nerfstudio's fisheye624_project (camera_utils.py)."""
    fu, fv, cu, cv, *rest = params
    k, (p0, p1), s = rest[:6], rest[6:8], rest[8:]

    def project(in_camera):
        a, b = in_camera[:2] / in_camera[2]
        r = np.hypot(a, b)
        theta = np.arctan(r)
        bent = theta + sum(value * theta ** (3 + 2 * index) for index, value in enumerate(k))
        x, y = bent * a / r, bent * b / r
        r2 = x * x + y * y
        u = x + (2 * x * x + r2) * p0 + 2 * x * y * p1 + s[0] * r2 + s[1] * r2 * r2
        v = y + (2 * y * y + r2) * p1 + 2 * x * y * p0 + s[2] * r2 + s[3] * r2 * r2
        return fu * u + cu, fv * v + cv

    return project


def transforms_fisheye624() -> None:
    """After nerfstudio's process_project_aria.py; pixels by the formula in nerfstudio, which pycolmap's model agrees with."""
    bend = [-0.03, 0.1, -0.07, 0.012, 0.002, -0.001, 0.0005, -0.0008, 0.001, -0.0003, -0.0007, 0.0002]
    params = [F, 92.5, CX, CY, *bend]
    project, lens = fisheye624(params), camera("RAD_TAN_THIN_PRISM_FISHEYE", params)
    path = folder("transforms_fisheye624")
    frames = [
        {
            "fl_x": F, "fl_y": 92.5, "cx": CX, "cy": CY, "distortion_params": bend, "w": W, "h": H,
            "file_path": f"images/{name}", "timestamp": 1000 + index,
            "transform_matrix": (np.linalg.inv(matrix(pose)) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        for index, (name, pose) in enumerate(POSES.items())
    ]
    for pose in POSES.values():
        for point in POINTS:
            assert np.allclose(project(pose * point), lens.img_from_cam(pose * point), atol=1e-9)
    (path / "transforms.json").write_text(json.dumps({"camera_model": "FISHEYE624", "frames": frames}, indent=1))
    write_projections(path, project)


def numbers(values) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(values))


def rotation_of(x, y, z, w) -> np.ndarray:
    q = np.array([x, y, z, w]) / np.linalg.norm([x, y, z, w])
    return pycolmap.Rotation3d(q).matrix()


# World from component: rotation, translation, scale.
COMPONENT = (rotation_of(0.2, -0.5, 0.1, 0.8), np.array([3.0, -2.0, 5.0]), 1.7)


def metashape_xml(
    calibration: dict, kind: str, component=COMPONENT, in_chunk: bool = False, initial: bool = True, height: int = H
) -> str:
    """After the files that Metashape 2 writes."""
    rotation, translation, scale = component
    transform = (
        f'<transform><rotation locked="false">{numbers(rotation)}</rotation>'
        f'<translation locked="false">{numbers(translation)}</translation>'
        f'<scale locked="false">{scale:.17g}</scale></transform>'
    )
    cameras = []
    for index, (name, pose) in enumerate(POSES.items()):
        world_from_camera = np.linalg.inv(matrix(pose))
        local = np.eye(4)
        local[:3, :3] = rotation.T @ world_from_camera[:3, :3]
        local[:3, 3] = rotation.T @ (world_from_camera[:3, 3] - translation) / scale
        owner = "" if in_chunk else ' component_id="0"'
        cameras.append(
            f'<camera id="{index}" sensor_id="0"{owner} label="{Path(name).stem}">'
            f"<transform>{numbers(local)}</transform><orientation>1</orientation></camera>"
        )
    values = "".join(f"<{key}>{value:.17g}</{key}>" for key, value in calibration.items())
    size = f'<resolution width="{W}" height="{height}"/>'
    components = (
        "" if in_chunk else
        f'<components next_id="1" active_id="0"><component id="0" label="Component 1">{transform}</component></components>'
    )
    return "\n".join([
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<document version="2.0.0">',
        '  <chunk label="Chunk 1" enabled="true">',
        '    <sensors next_id="1">',
        f'      <sensor id="0" label="unknown" type="{kind}">{size}<property name="layer_index" value="0"/>',
        f'        <calibration type="{kind}" class="initial">{size}<f>1</f></calibration>' if initial else "",
        f'        <calibration type="{kind}" class="adjusted">{size}{values}</calibration>',
        "      </sensor>",
        "    </sensors>",
        f"    {components}",
        '    <cameras next_id="9" next_group_id="1">',
        *[f"      {camera}" for camera in cameras[:3]],
        '      <group id="0" label="Group 1" type="folder">',
        *[f"        {camera}" for camera in cameras[3:]],
        "      </group>",
        '      <camera id="7" sensor_id="0" component_id="0" label="off" enabled="false">'
        f"<transform>{numbers(np.eye(4))}</transform></camera>",
        '      <camera id="8" sensor_id="0" label="not_aligned"/>',
        "    </cameras>",
        f"    {transform if in_chunk else ''}",
        "    <reference>LOCAL_CS[&quot;Local Coordinates&quot;,LOCAL_DATUM[&quot;Local Datum&quot;,0]]</reference>",
        "  </chunk>",
        "</document>",
        "",
    ])


def metashape() -> None:
    """Lens of a frame camera by EasyIDP, of a fisheye by pycolmap (whose p1, p2 are the other way round)."""
    for name in ["pyproj", "skimage", "skimage.io"]:
        sys.modules[name] = MagicMock()
    for name in ["easyidp", "easyidp.logger"]:
        sys.modules[name] = MagicMock()
    place = importlib.util.find_spec("camorph").submodule_search_locations[0]
    source = Path(place).parent / "easyidp/reconstruct.py"
    spec = importlib.util.spec_from_file_location("easyidp.reconstruct", source)
    reconstruct = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reconstruct)
    values = {
        "f": F, "cx": CX - W / 2, "cy": CY - H / 2, "b1": 1.25, "b2": -0.75,
        "k1": K1, "k2": K2, "k3": 0.02, "k4": -0.01, "p1": 0.004, "p2": -0.007,
    }
    judge = types.SimpleNamespace(
        **{key: value for key, value in values.items() if key not in ("p1", "p2")},
        t1=values["p1"], t2=values["p2"], sensor=types.SimpleNamespace(width=W, height=H),
    )

    def by_easyidp(in_camera):
        x, y = in_camera[:2] / in_camera[2]
        u, v = reconstruct.Calibration._calibrate_metashape_frame(judge, np.array([x]), np.array([y]))
        return u[0], v[0]

    for name, in_chunk in [("metashape_frame", False), ("metashape_chunk", True)]:
        path = folder(name)
        (path / "cameras.xml").write_text(metashape_xml(values, "frame", in_chunk=in_chunk))
        write_projections(path, by_easyidp)
    path = folder("metashape_fisheye")
    fisheye = {key: value for key, value in values.items() if key not in ("b1", "b2")}
    (path / "doc.xml").write_text(metashape_xml(fisheye, "fisheye"))
    judge_fisheye = camera(
        "THIN_PRISM_FISHEYE", [F, F, CX, CY, K1, K2, values["p2"], values["p1"], 0.02, -0.01, 0.0, 0.0]
    )
    write_projections(path, by_pycolmap(judge_fisheye))
    path = folder("metashape_spherical")
    (path / "cameras.xml").write_text(metashape_xml({}, "spherical", height=W // 2))
    panorama = pycolmap.Camera(camera_id=1, model="EQUIRECTANGULAR", width=W, height=W // 2, params=[W, W // 2])
    write_projections(path, by_pycolmap(panorama))
    # nerfstudio divides by the component's scale, takes p1, p2 in OpenCV's order and the first calibration: a file where
    # that is no matter.
    path = folder("metashape_plain")
    plain = {"f": F, "cx": CX - W / 2, "cy": CY - H / 2, "k1": K1, "k2": K2}
    (path / "cameras.xml").write_text(metashape_xml(plain, "frame", (*COMPONENT[:2], 1.0), initial=False))
    write_projections(path, by_pycolmap(camera("OPENCV", [F, F, CX, CY, K1, K2, 0.0, 0.0])))
    # The shared lens; no other program judges its order of p1, p2 but the above.
    path = folder("metashape")
    shared = plain | {"p1": P2, "p2": P1}
    (path / "cameras.xml").write_text(metashape_xml(shared, "frame"))
    write_projections(path, by_pycolmap(LENS))

    from nerfstudio.process_data import metashape_utils

    path = folder("transforms_metashape")
    names = {Path(name).stem: Path("images") / name for name in NAMES}
    metashape_utils.metashape_to_json(names, OUT / "metashape_plain/cameras.xml", path)
    shutil.copy(OUT / "metashape_plain/projections.txt", path)


def reality_capture() -> None:
    """Angles after nerfstudio's reading, which converts the table as well; pixels by pycolmap, or by nerfstudio's lens."""
    from nerfstudio.process_data import realitycapture_utils

    def table(k3: float, k4: float) -> str:
        lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
        for name, pose in POSES.items():
            world_from_camera = np.linalg.inv(matrix(pose))
            r = world_from_camera[:3, :3] @ FLIP
            angles = np.degrees([
                -np.arctan2(-r[0, 1], r[1, 1]), np.arcsin(r[2, 1]), np.arctan2(-r[2, 0], r[2, 2])
            ])
            side = max(W, H)
            rest = [F * 36 / side, (CX - W / 2) / side, (CY - H / 2) / side, K1, K2, k3, k4, P1, P2]
            values = [*world_from_camera[:3, 3], *angles, *rest]
            lines.append(name + "," + ",".join(f"{value:.17g}" for value in values))
        return "\n".join(lines) + "\n"

    path = folder("realitycapture")
    (path / "registration.csv").write_text(table(0.0, 0.0))
    write_projections(path, by_pycolmap(LENS))

    k3, k4 = 0.02, -0.01

    def by_formula(in_camera):
        x, y = in_camera[:2] / in_camera[2]
        r = x * x + y * y
        d = 1 + r * (K1 + r * (K2 + r * (k3 + r * k4)))
        return (
            F * (d * x + 2 * P1 * x * y + P2 * (r + 2 * x * x)) + CX,
            F * (d * y + 2 * P2 * x * y + P1 * (r + 2 * y * y)) + CY,
        )

    path = folder("realitycapture_all_terms")
    (path / "cameras.csv").write_text("#cameras 5\n" + table(k3, k4))
    write_projections(path, by_formula)
    path = folder("transforms_realitycapture")
    with tempfile.TemporaryDirectory() as work:
        work = Path(work)
        (work / "images").mkdir()
        for name in NAMES:
            Image.new("RGB", (W, H)).save(work / "images" / name)
        (work / "table.csv").write_text(table(k3, k4))
        names = {Path(name).stem: Path("images") / name for name in NAMES}
        realitycapture_utils.realitycapture_to_json(names, work / "table.csv", None, work)
        shutil.copy(work / "transforms.json", path)
    write_projections(path, by_formula)

    # Its COLMAP export: undistorted or not, sparse/0 as text, without 2D points; judged by pycolmap, which reads it.
    path = folder("realitycapture_colmap")
    model = path / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"# Number of cameras: {len(NAMES)}\n"
        + "".join(f"{i} OPENCV {W} {H} {numbers(LENS.params)}\n" for i in range(1, len(NAMES) + 1))
    )
    lines = ["# Image list with two lines of data per image:"]
    for index, (name, pose) in enumerate(POSES.items(), 1):
        x, y, z, w = pose.rotation.quat
        lines += [f"{index} {numbers([w, x, y, z, *pose.translation])} {index} {name}", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text(
        "".join(f"{i + 1} {numbers(p)} {' '.join(map(str, COLORS[i]))} 0.5\n" for i, p in enumerate(POINTS))
    )
    read = pycolmap.Reconstruction(model)
    poses = {image.name: image.cam_from_world() for image in read.images.values()}
    write_projections(path, by_pycolmap(read.cameras[1]), {name: poses[name] for name in NAMES})


def meshroom() -> None:
    """After AliceVision's jsonIO; poses judged by camorph, which reads the files."""
    from camorph.ext.Meshroom.util import ReaderSyntacticUtil

    def write(path: Path, version: list[int], intrinsic: dict, extra: dict | None = None) -> None:
        views, poses = [], []
        for index, (name, pose) in enumerate(POSES.items()):
            world_from_camera = np.linalg.inv(matrix(pose))
            views.append({
                "viewId": str(4000000000 + index), "poseId": str(100 + index), "intrinsicId": "77",
                "path": f"C:\\photos/vase/{name}", "width": str(W), "height": str(H), "metadata": "",
            })
            poses.append({
                "poseId": str(100 + index),
                "pose": {
                    "transform": {
                        # Column by column, as Eigen keeps the rotation from the world.
                        "rotation": [f"{v:.17g}" for v in pose.rotation.matrix().T.ravel()],
                        "center": [f"{v:.17g}" for v in world_from_camera[:3, 3]],
                    },
                    "locked": "0",
                },
            })
        views.append({"viewId": "5", "poseId": "5", "intrinsicId": "77", "path": "/x/not_aligned.png",
                      "width": str(W), "height": str(H)})
        data = {
            "version": [str(part) for part in version],
            "featuresFolders": "",
            "views": views,
            "intrinsics": [{
                "intrinsicId": "77", "width": str(W), "height": str(H), "serialNumber": "",
                "initializationMode": "estimated", "locked": "0",
            } | intrinsic],
            "poses": poses,
        } | (extra or {})
        (path).write_text(json.dumps(data, indent=1))

    def judged_poses(path: Path) -> dict:
        """Centre and rotation into the world, as camorph reads them."""
        poses = {}
        for seen in ReaderSyntacticUtil.read_sfm(str(path)):
            rotation = seen.r.rotation_matrix.T
            name = f"{seen.name}.png"
            poses[name] = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ np.asarray(seen.t))
        return {name: poses[name] for name in NAMES}

    def texts(values) -> list[str]:
        return [f"{value:.17g}" for value in values]

    structure = [
        {
            "landmarkId": str(index), "descType": "sift", "color": [str(value) for value in COLORS[index]],
            "X": texts(point),
            "observations": [
                {"observationId": str(4000000000 + view), "featureId": "1",
                 "x": texts(LENS.img_from_cam(POSES[name] * point) + np.array([0.3, 0.4]))}
                for view, name in enumerate(NAMES[:3])
            ],
        }
        for index, point in enumerate(POINTS)
    ]
    # Before 1.2: one focal length in pixels, principal point from the corner.
    path = folder("meshroom_old")
    write(path / "cameras.sfm", [1, 0, 0], {
        "type": "radial3", "pxInitialFocalLength": "90", "pxFocalLength": f"{F}",
        "principalPoint": texts([CX, CY]), "distortionParams": texts([K1, K2, 0.02]),
    })
    lens = camera("FULL_OPENCV", [F, F, CX, CY, K1, K2, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0])
    write_projections(path, by_pycolmap(lens), judged_poses(path / "cameras.sfm"))
    # Today: millimetres, principal point from the centre, the lens beside the type.
    path = folder("meshroom")
    millimetres = {"sensorWidth": "36", "sensorHeight": "24", "initialFocalLength": "-1",
                   "focalLength": f"{F * 36 / W:.17g}", "pixelRatioLocked": "true"}
    write(path / "sfm.json", [1, 2, 8], millimetres | {
        "type": "pinhole", "pixelRatio": "1", "principalPoint": texts([CX - W / 2, CY - H / 2]),
        "distortionInitializationMode": "none", "distortionParams": texts([K1, K2, 0.0, P1, P2]),
        "undistortionOffset": ["0", "0"], "undistortionParams": "", "distortionType": "brown",
        "undistortionType": "none",
    }, {"structure": structure})
    write_projections(path, by_pycolmap(LENS), judged_poses(path / "sfm.json"))
    # In between: pixelRatio is fx / fy; a fisheye whose lens is its type.
    path = folder("meshroom_fisheye")
    write(path / "cameras.sfm", [1, 2, 3], millimetres | {
        "type": "fisheye4", "pixelRatio": f"{F / 92.5:.17g}", "principalPoint": texts([CX - W / 2, CY - H / 2]),
        "distortionParams": texts([-0.05, 0.02, -0.01, 0.003]),
    })
    lens = camera("OPENCV_FISHEYE", [F, 92.5, CX, CY, -0.05, 0.02, -0.01, 0.003])
    write_projections(path, by_pycolmap(lens), judged_poses(path / "cameras.sfm"))
    # One angle for the whole lens: COLMAP's FOV, as AliceVision's own export to COLMAP has it.
    path = folder("meshroom_fisheye1")
    write(path / "cameras.sfm", [1, 2, 6], millimetres | {
        "type": "fisheye1", "pixelRatio": "1", "principalPoint": texts([CX - W / 2, CY - H / 2]),
        "distortionParams": texts([0.9]),
    })
    write_projections(path, by_pycolmap(camera("FOV", [F, F, CX, CY, 0.9])), judged_poses(path / "cameras.sfm"))
    path = folder("meshroom_spherical")
    write(path / "cameras.sfm", [1, 2, 8], millimetres | {
        "type": "equirectangular", "height": str(W // 2), "focalLength": f"{36 / (2 * np.pi):.17g}", "pixelRatio": "1",
        "principalPoint": ["0", "0"], "distortionParams": "",
    })
    panorama = pycolmap.Camera(camera_id=1, model="EQUIRECTANGULAR", width=W, height=W // 2, params=[W, W // 2])
    write_projections(path, by_pycolmap(panorama), judged_poses(path / "cameras.sfm"))


def opensfm() -> None:
    """After OpenSfM's documentation; poses judged by nerfstudio's reading of OpenDroneMap, lenses by pycolmap."""
    from nerfstudio.process_data import odm_utils

    def axis_angle(pose) -> np.ndarray:
        x, y, z, w = pose.rotation.quat
        axis = np.array([x, y, z])
        length = np.linalg.norm(axis)
        return axis / length * 2 * np.arctan2(length, w)

    def write(path: Path, lens: dict) -> dict:
        path.parent.mkdir(parents=True, exist_ok=True)
        shots = {
            name: {"rotation": axis_angle(pose).tolist(), "translation": pose.translation.tolist(),
                   "camera": "v2 unknown", "orientation": 1, "capture_time": 0.0}
            for name, pose in POSES.items()
        }
        points = {
            str(index): {"color": [float(v) for v in COLORS[index]], "coordinates": point.tolist()}
            for index, point in enumerate(POINTS)
        }
        cameras = {"v2 unknown": {"width": W, "height": H} | lens}
        whole = {"cameras": cameras, "shots": shots, "points": points,
                 "reference_lla": {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}}
        part = {"cameras": cameras, "shots": {NAMES[0]: shots[NAMES[0]]}, "points": {}}
        path.write_text(json.dumps([part, whole], indent=1))
        with tempfile.TemporaryDirectory() as work:
            work = Path(work)
            alone = {"projection_type": "perspective", "width": W, "height": H, "focal": 1.0, "c_x": 0.0, "c_y": 0.0}
            (work / "cameras.json").write_text(json.dumps({"v2 unknown": alone}))
            (work / "reconstruction.json").write_text(json.dumps([whole]))
            names = {Path(name).stem: Path(name) for name in NAMES}
            odm_utils.cameras2nerfds(names, work / "cameras.json", work / "x", work / "reconstruction.json", work)
            frames = json.loads((work / "transforms.json").read_text())["frames"]
        poses = {}
        for frame in frames:
            world_from_camera = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
            poses[frame["file_path"]] = pycolmap.Rigid3d(np.linalg.inv(world_from_camera)[:3])
        return {name: poses[name] for name in NAMES}

    side = max(W, H)
    center = {"c_x": (CX - W / 2) / side, "c_y": (CY - H / 2) / side}
    both = {"focal_x": F / side, "focal_y": F / side}
    path = folder("opensfm")
    poses = write(path / "opensfm/reconstruction.json", {
        "projection_type": "brown", **both, **center, "k1": K1, "k2": K2, "p1": P1, "p2": P2, "k3": 0.0,
    })
    write_projections(path, by_pycolmap(LENS), poses)
    path = folder("opensfm_perspective")
    poses = write(path / "reconstruction.json", {"projection_type": "perspective", "focal": F / side, "k1": K1, "k2": K2})
    write_projections(path, by_pycolmap(CENTERED), poses)
    path = folder("opensfm_fisheye")
    poses = write(path / "reconstruction.json", {
        "projection_type": "fisheye_opencv", "focal_x": F / side, "focal_y": 92.5 / side, **center,
        "k1": -0.05, "k2": 0.02, "k3": -0.01, "k4": 0.003,
    })
    lens = camera("OPENCV_FISHEYE", [F, 92.5, CX, CY, -0.05, 0.02, -0.01, 0.003])
    write_projections(path, by_pycolmap(lens), poses)
    # Six radial and two tangential terms, in numpy after OpenSfM's Disto62; with four of them it is COLMAP's thin prism.
    def disto62(k, p1, p2):
        def project(in_camera):
            a, b = in_camera[:2]
            r = np.hypot(a, b)
            theta = np.arctan2(r, in_camera[2])
            x, y = theta * a / r, theta * b / r
            r2 = theta * theta
            bent = 1 + sum(value * r2 ** (index + 1) for index, value in enumerate(k))
            u = x * bent + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            v = y * bent + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
            return F * u + CX, 92.5 * v + CY

        return project

    four = camera("THIN_PRISM_FISHEYE", [F, 92.5, CX, CY, -0.05, 0.02, P1, P2, -0.01, 0.003, 0.0, 0.0])
    for pose in POSES.values():
        for point in POINTS:
            seen = disto62([-0.05, 0.02, -0.01, 0.003, 0.0, 0.0], P1, P2)(pose * point)
            assert np.allclose(seen, four.img_from_cam(pose * point), atol=1e-9)
    path = folder("opensfm_fisheye62")
    bend = [-0.05, 0.02, -0.01, 0.003, 0.002, -0.001]
    poses = write(path / "reconstruction.json", {
        "projection_type": "fisheye62", "focal_x": F / side, "focal_y": 92.5 / side, **center,
        **{f"k{index + 1}": value for index, value in enumerate(bend)}, "p1": P1, "p2": P2,
    })
    write_projections(path, disto62(bend, P1, P2), poses)
    path = folder("opensfm_spherical")
    poses = write(path / "reconstruction.json", {"projection_type": "spherical", "width": W, "height": W // 2})
    lens = pycolmap.Camera(camera_id=1, model="EQUIRECTANGULAR", width=W, height=W // 2, params=[W, W // 2])
    write_projections(path, by_pycolmap(lens), poses)


def bundler() -> None:
    """After Bundler's manual; poses judged by kapture, which reads the file, the lens by pycolmap."""
    path = folder("bundler")
    (path / "bundle").mkdir()
    lines = ["# Bundle file v0.3", f"{len(NAMES) + 1} {len(POINTS)}"]
    for pose in POSES.values():
        lines.append(numbers([F, K1, K2]))
        lines += [numbers(row) for row in FLIP @ pose.rotation.matrix()]
        lines.append(numbers(FLIP @ pose.translation))
    lines += ["0 0 0"] * 5
    for point, color in zip(POINTS, COLORS):
        lines += [numbers(point), " ".join(map(str, color))]
        views = []
        for index, name in enumerate(NAMES[:3]):
            x, y = CENTERED.img_from_cam(POSES[name] * point) + np.array([0.3, 0.4])
            views.append(f"{index} 0 {x - W / 2:.17g} {H / 2 - y:.17g}")
        lines.append(f"{len(views)} {' '.join(views)}")
    (path / "bundle/bundle.out").write_text("\n".join(lines) + "\n")
    (path / "list.txt").write_text("".join(f"./images/{name} 0 {F}\n" for name in [*NAMES, "not_aligned.png"]))

    numba = MagicMock()
    numba.njit = lambda *args, **_: args[0] if args else lambda function: function
    sys.modules["numba"] = numba
    sys.modules["piexif"] = sys.modules["quaternion.numba_wrapper"] = MagicMock()
    place = Path(importlib.util.find_spec("camorph").submodule_search_locations[0]).parent
    spec = importlib.util.spec_from_file_location("import_bundler", place / "tools/kapture_import_bundler.py")
    importer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(importer)
    with tempfile.TemporaryDirectory() as work:
        work = Path(work)
        (work / "list.txt").write_text("".join(f"{name}\n" for name in [*NAMES, "not_aligned.png"]))
        # Its quaternions cannot be made of the zeros of cameras that were not aligned.
        text = (path / "bundle/bundle.out").read_text().split("\n")
        text[1] = f"{len(NAMES)} {len(POINTS)}"
        del text[2 + 5 * len(NAMES) : 7 + 5 * len(NAMES)]
        (work / "bundle.out").write_text("\n".join(text))
        for name in NAMES:
            Image.new("RGB", (W, H)).save(work / name)
        importer.import_bundler(str(work / "bundle.out"), str(work / "list.txt"), str(work), str(work / "kapture"), False, False)
        poses = {}
        for line in (work / "kapture/sensors/trajectories.txt").read_text().splitlines():
            if not line.startswith("#"):
                index, _, w, x, y, z, *translation = [part.strip() for part in line.split(",")]
                pose = np.eye(4)
                pose[:3, :3] = rotation_of(*map(float, (x, y, z, w)))
                pose[:3, 3] = [float(value) for value in translation]
                # kapture turns the world half around x as well.
                pose[:3, :3] = pose[:3, :3] @ FLIP
                poses[NAMES[int(index)]] = pycolmap.Rigid3d(pose[:3])
    write_projections(path, by_pycolmap(CENTERED), {name: poses[name] for name in NAMES})


def main() -> None:
    stand_in_for_heavy_imports()
    OUT.mkdir(exist_ok=True)
    for write in [
        colmap, colmap_rig, transforms_nerfstudio, transforms_scaled, transforms_ngp, transforms_fisheye624, metashape, reality_capture, meshroom, opensfm, bundler,
    ]:
        write()


if __name__ == "__main__":
    main()
