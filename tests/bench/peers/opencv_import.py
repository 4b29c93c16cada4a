"""Import of photographs with OpenCV: imread, undistort the crop with remap, scale with INTER_AREA. The maps of the lens
are made once; a crop takes its part of them. Views go over threads, each with OpenCV's own threads off.
"""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy
import peer


def main():
    options = peer.arguments()
    data = peer.load(options.data, "import.json")
    cameras = data["cameras"][: options.views]
    fx, fy, cx, cy, *bends = data["lens"]
    cv2.setNumThreads(1)
    started = time.perf_counter()
    # OpenCV counts pixels from the centre of the first one.
    matrix = numpy.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    bends = numpy.array(bends)
    height, width = cv2.imread(os.path.join(options.data, "0.jpg")).shape[:2]
    maps = cv2.initUndistortRectifyMap(matrix, bends, None, matrix, (width, height), cv2.CV_16SC2)
    prepare_secs = time.perf_counter() - started

    def load(view):
        camera = cameras[view]
        image = cv2.imread(os.path.join(options.data, f"{view % data['photographs']}.jpg"))
        scale = fx / camera["fx"]
        x0, y0 = round(cx - camera["cx"] * scale), round(cy - camera["cy"] * scale)
        x1, y1 = round(x0 + camera["width"] * scale), round(y0 + camera["height"] * scale)
        left, top, right, bottom = max(-x0, 0), max(-y0, 0), max(x1 - width, 0), max(y1 - height, 0)
        part = numpy.s_[max(y0, 0) : min(y1, height), max(x0, 0) : min(x1, width)]
        crop = cv2.remap(image, maps[0][part], maps[1][part], cv2.INTER_LINEAR)
        if left or top or right or bottom:
            crop = cv2.copyMakeBorder(crop, top, bottom, left, right, cv2.BORDER_CONSTANT)
        small = cv2.resize(crop, (camera["width"], camera["height"]), interpolation=cv2.INTER_AREA)
        return float(small.mean()) / 255

    started = time.perf_counter()
    with ThreadPoolExecutor(options.threads) as pool:
        means = list(pool.map(load, range(len(cameras))))
    secs = time.perf_counter() - started
    peer.report(items=len(cameras), secs=secs, prepare_secs=prepare_secs, check={"mean": sum(means) / len(means)})


main()
