#!/usr/bin/env python3
"""Writes small COLMAP models, one per camera model, with pixels as COLMAP itself projects them.

    python -m venv /tmp/venv && /tmp/venv/bin/pip install pycolmap==4.2.0 numpy
    /tmp/venv/bin/python make_colmap_models.py

Each folder gets the model in binary and text form and `projections.txt`, one line per observation:
    IMAGE_NAME X Y Z PX PY
with the world point and the pixel that pycolmap's camera gives for it. The tests of ign-capture read them.
The script is seeded: running it again writes the same files.
"""
from pathlib import Path

import numpy as np
import pycolmap

# Asymmetric on purpose: width and height, focal lengths, principal point and rotations are all general.
SIZE = (96, 70)
PARAMS = {
    "SIMPLE_PINHOLE": [88.0, 45.5, 37.25],
    "PINHOLE": [88.0, 92.5, 45.5, 37.25],
    "SIMPLE_RADIAL": [88.0, 45.5, 37.25, -0.12],
    "RADIAL": [88.0, 45.5, 37.25, -0.21, 0.08],
    "OPENCV": [88.0, 92.5, 45.5, 37.25, -0.18, 0.06, 0.004, -0.007],
    "OPENCV_FISHEYE": [88.0, 92.5, 45.5, 37.25, -0.05, 0.02, -0.01, 0.003],
    "FULL_OPENCV": [88.0, 92.5, 45.5, 37.25, 0.11, 0.05, 0.003, -0.002, 0.01, 0.2, 0.04, 0.015],
    "SIMPLE_RADIAL_FISHEYE": [88.0, 45.5, 37.25, -0.07],
    "RADIAL_FISHEYE": [88.0, 45.5, 37.25, -0.07, 0.02],
    "SIMPLE_FISHEYE": [88.0, 45.5, 37.25],
    "FISHEYE": [88.0, 92.5, 45.5, 37.25],
    "FOV": [88.0, 92.5, 45.5, 37.25, 0.85],
    "THIN_PRISM_FISHEYE": [
        88.0, 92.5, 45.5, 37.25, -0.05, 0.02, 0.004, -0.007, -0.01, 0.003, 0.006, -0.005,
    ],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        88.0, 92.5, 45.5, 37.25, -0.05, 0.02, -0.01, 0.003, -0.002, 0.001, 0.004, -0.007, 0.006, 0.003, -0.005, 0.002,
    ],
    "SIMPLE_DIVISION": [88.0, 45.5, 37.25, -0.11],
    "DIVISION": [88.0, 92.5, 45.5, 37.25, -0.13],
    "EUCM": [88.0, 92.5, 45.5, 37.25, 0.62, 1.08],
    "EQUIRECTANGULAR": [96.0, 70.0],
}
IMAGES = 3
POINTS = 12


def pose(rng: np.random.Generator) -> pycolmap.Rigid3d:
    """A camera about four units away that looks roughly at the origin, with any roll."""
    quaternion = rng.normal(size=4)
    rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
    translation = np.array([0.0, 0.0, 4.0]) + rng.uniform(-0.3, 0.3, size=3)
    return pycolmap.Rigid3d(rotation, translation)


def write(name: str, params: list[float], seed: int, out: Path) -> None:
    rng = np.random.default_rng(seed)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=7, model=name, width=SIZE[0], height=SIZE[1], params=params
    )
    model.add_camera_with_trivial_rig(camera)
    points = rng.uniform(-1.0, 1.0, size=(POINTS, 3))
    lines = []
    observed = {index: [] for index in range(POINTS)}
    for image_id in range(1, IMAGES + 1):
        cam_from_world = pose(rng)
        seen = []
        for index, point in enumerate(points):
            pixel = camera.img_from_cam(cam_from_world * point)
            if pixel is None:
                continue
            lines.append((f"view {image_id}.png", point, pixel))
            observed[index].append((image_id, len(seen)))
            seen.append(pixel)
        image = pycolmap.Image(
            image_id=image_id, name=f"view {image_id}.png", camera_id=7, keypoints=np.array(seen)
        )
        model.add_image_with_trivial_frame(image, cam_from_world)
    for index, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(i, j) for i, j in observed[index]])
        color = rng.integers(0, 256, size=3).astype(np.uint8)
        model.add_point3D(point, track, color)
    folder = out / name.lower()
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    model.write_text(folder)
    for extra in ("rigs", "frames"):
        for extension in ("bin", "txt"):
            (folder / f"{extra}.{extension}").unlink(missing_ok=True)
    with open(folder / "projections.txt", "w") as file:
        for image, point, pixel in lines:
            numbers = " ".join(f"{value:.17g}" for value in [*point, *pixel])
            file.write(f"{image.replace(' ', '_')} {numbers}\n")


def main() -> None:
    out = Path(__file__).parent / "colmap"
    for seed, (name, params) in enumerate(PARAMS.items()):
        write(name, params, seed, out)


if __name__ == "__main__":
    main()
