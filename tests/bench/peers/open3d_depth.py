"""Depth of the views by Open3D's ray caster (Embree). Only the casting is timed: its rays are made beforehand, view by
view. It returns distance, triangle, weights and face normal per ray; here the direction has z = 1, so distance is depth.
"""

import os
import time

import numpy
import open3d
import peer

core = open3d.core


def main():
    options = peer.arguments()
    cameras = peer.load(options.data, "cameras.json")[: options.views]
    positions = numpy.fromfile(os.path.join(options.data, "positions.f32"), "<f4").reshape(-1, 3)
    triangles = numpy.fromfile(os.path.join(options.data, "triangles.u32"), "<u4").reshape(-1, 3)
    scene = open3d.t.geometry.RaycastingScene(nthreads=options.threads)
    started = time.perf_counter()
    scene.add_triangles(core.Tensor(positions), core.Tensor(triangles))
    # The hierarchy is built by the first cast.
    scene.cast_rays(core.Tensor([[9, 9, 9, 0, 0, 1]], core.float32), nthreads=options.threads)
    prepare_secs = time.perf_counter() - started
    secs = covered = depth = pixels = 0
    for camera in cameras:
        k = camera["intrinsics"]
        pose = numpy.eye(4)
        pose[:3, :3] = camera["rotation"]
        pose[:3, 3] = camera["translation"]
        intrinsics = core.Tensor([[k["fx"], 0, k["cx"]], [0, k["fy"], k["cy"]], [0, 0, 1]], core.float64)
        rays = scene.create_rays_pinhole(intrinsics, core.Tensor(pose), k["width"], k["height"])
        started = time.perf_counter()
        hits = scene.cast_rays(rays, nthreads=options.threads)
        secs += time.perf_counter() - started
        distance = hits["t_hit"].numpy()
        hit = distance[numpy.isfinite(distance)]
        covered += hit.size
        depth += float(hit.sum(dtype=numpy.float64))
        pixels += k["width"] * k["height"]
    peer.report(
        items=len(cameras), secs=secs, prepare_secs=prepare_secs, pixels=pixels,
        check={"covered": covered / len(cameras), "mean_depth": depth / covered},
    )


main()
