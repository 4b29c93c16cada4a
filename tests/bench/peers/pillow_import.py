"""Import of photographs with Pillow: draft mode decodes to a quarter of the size, a mesh transform undistorts the crop
at twice the wanted size, a box filter halves it. Draft mode keeps the low frequencies of each block, so its result is
blurrier than area means; Pillow has no lens model, so the mesh comes from OpenCV and is made before the clock starts.
"""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy
import peer
from PIL import Image

CELL, MESH = 4, 32


def main():
    options = peer.arguments()
    data = peer.load(options.data, "import.json")
    cameras = data["cameras"][: options.views]
    fx, fy, cx, cy, *bends = data["lens"]
    matrix = numpy.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    started = time.perf_counter()

    def mesh(camera):
        """Boxes of the wanted picture at twice its size, and the corners of each in the drafted photograph."""
        side = 2 * camera["width"]
        steps = numpy.arange(0, side + 1, MESH)
        x, y = numpy.meshgrid(steps / 2, steps / 2)
        rays = numpy.stack([(x - camera["cx"]) / camera["fx"], (y - camera["cy"]) / camera["fy"], x * 0 + 1], -1)
        points = cv2.projectPoints(rays.reshape(-1, 1, 3), numpy.zeros(3), numpy.zeros(3), matrix, numpy.array(bends))
        at = points[0].reshape(len(steps), len(steps), 2) / CELL
        boxes = []
        for row in range(len(steps) - 1):
            for column in range(len(steps) - 1):
                corners = [at[row, column], at[row + 1, column], at[row + 1, column + 1], at[row, column + 1]]
                box = (column * MESH, row * MESH, (column + 1) * MESH, (row + 1) * MESH)
                boxes.append((box, tuple(float(value) for corner in corners for value in corner)))
        return boxes

    meshes = [mesh(camera) for camera in cameras]
    prepare_secs = time.perf_counter() - started

    def load(view):
        camera = cameras[view]
        image = Image.open(os.path.join(options.data, f"{view % data['photographs']}.jpg"))
        image.draft("RGB", (image.width // CELL, image.height // CELL))
        size = (camera["width"], camera["height"])
        double = image.transform((2 * size[0], 2 * size[1]), Image.Transform.MESH, meshes[view], Image.Resampling.BILINEAR)
        return float(numpy.asarray(double.resize(size, Image.Resampling.BOX)).mean()) / 255

    started = time.perf_counter()
    with ThreadPoolExecutor(options.threads) as pool:
        means = list(pool.map(load, range(len(cameras))))
    secs = time.perf_counter() - started
    peer.report(items=len(cameras), secs=secs, prepare_secs=prepare_secs, check={"mean": sum(means) / len(means)})


main()
