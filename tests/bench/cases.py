"""What is measured. A case pairs a benchmark program of this repository with a peer that does the same work.

Both sides take `--views N` and print one line of JSON: `items` (what was done), `secs` (time for it), `prepare_secs`
(time once, whatever N), `peak_bytes` (VmHWM) and `check` (figures that both sides must agree on). Our program takes
its threads from RAYON_NUM_THREADS and writes what the peer reads with `--export DIR`; the peer is a script in `peers/`
that takes `--data DIR` and `--threads N`.
"""

from dataclasses import dataclass
from typing import Callable


@dataclass(frozen=True)
class Case:
    name: str
    does: str
    bench: str
    arguments: tuple[str, ...]
    """Of the benchmark target."""
    peer: str
    unit: str
    views: int
    limit_bytes: Callable[[dict], float] | None = None
    """Bytes that have to move per item, from our side's result; over the measured bandwidth: the machine's limit. None
    where the limit is another one."""
    limit_means: str = ""
    peer_runs: int | None = None
    """At most this many runs of the peer, where it is slow."""
    requirements: str = "requirements.txt"
    """What the peer imports."""


@dataclass(frozen=True)
class ServiceCase:
    """A benchmark program that starts its own peers, and prints its figures with their targets."""
    name: str
    does: str
    bench: str
    programs: tuple[str, ...]
    """What it starts."""


def mesh_bytes(result):
    """Half of the mesh, the side that is seen, read once per view: f32 positions and indices."""
    return (12 * result["vertices"] + 12 * result["triangles"]) / 2


def map_bytes(result, per_pixel):
    return per_pixel * result["pixels"] / result["items"]


def network(name, net, does, steps, frames):
    """The two cases of a network: training steps and frames, beside the same thing in eager PyTorch."""
    for work, unit, count, what in [("train", "step", steps, "training steps"), ("render", "frame", frames, "frames of 256 px")]:
        yield Case(
            name=f"{name}_{work}", does=f"{what}: {does[work]}",
            bench="networks", arguments=("--net", net, "--work", work),
            peer="torch_networks.py", unit=unit, views=count, requirements="requirements-torch.txt",
        )


NETWORKS = [
    *network("paper_effects", "paper_effects", {
        "train": "the paper's EffectsNet on a pair of 128 px", "render": "the paper's EffectsNet",
    }, 20, 20),
    *network("paper_composition", "paper_composition", {
        "train": "the paper's CompositionNet against its discriminator, 128 px", "render": "the paper's CompositionNet",
    }, 10, 10),
    *network("point_effects", "point_effects", {
        "train": "EffectsNet of preset standard, 8192 pairs", "render": "EffectsNet of preset standard, a point a pixel",
    }, 60, 20),
    *network("blend", "blend", {
        "train": "CompositionNet of preset standard, 8 windows of 32 px", "render": "CompositionNet of preset standard",
    }, 20, 20),
]

CASES = [
    Case(
        name="depth",
        does="depth and triangle of each pixel (Drawable::rasterize); peer: Open3D RaycastingScene, casting alone",
        bench="gbuffers", arguments=("--maps", "depth"),
        peer="open3d_depth.py", unit="view", views=1000,
        limit_bytes=lambda r: mesh_bytes(r) + map_bytes(r, 8),
        limit_means="the visible half of the mesh read once, 8 bytes a pixel written once",
    ),
    Case(
        name="gbuffers",
        does="all maps of a G-buffer (Drawable::g_buffer); peer: the same as for depth, so it does less",
        bench="gbuffers", arguments=("--maps", "all"),
        peer="open3d_depth.py", unit="view", views=1000,
        limit_bytes=lambda r: mesh_bytes(r) + map_bytes(r, 61),
        limit_means="the visible half of the mesh read once, 61 bytes a pixel written once",
    ),
    Case(
        name="selection",
        does="20 references by lazy greedy (select::Candidates::choose); peer: the same greedy, every gain, in NumPy",
        bench="selection", arguments=(),
        peer="numpy_greedy.py", unit="view", views=1000, peer_runs=1,
        limit_bytes=lambda r: r["table_bytes"] * (1 + len(r["check"]["chosen"])) / r["items"],
        limit_means="the tables of costs, rays and weights read once for the first gains and once per choice",
    ),
    Case(
        name="import",
        does="24-megapixel JPEGs to 512 px around the object (Scene::load_view); peer: OpenCV imread, remap, INTER_AREA",
        bench="import", arguments=(),
        peer="opencv_import.py", unit="view", views=1000,
        limit_bytes=lambda r: r["photograph_bytes"] + r["output_bytes"],
        limit_means="the file read once, the picture written once",
    ),
    Case(
        name="import_draft",
        does="the same; peer: Pillow in draft mode at 1/4, mesh transform for the lens, box filter",
        bench="import", arguments=(),
        peer="pillow_import.py", unit="view", views=1000,
        limit_bytes=lambda r: r["photograph_bytes"] + r["output_bytes"],
        limit_means="the file read once, the picture written once",
    ),
    *NETWORKS,
]

SERVICES = [
    ServiceCase(
        name="service",
        does="coordinator, Postgres and SQLite under load through gRPC and HTTP; peers: pgbench -N, curl to the S3 server",
        bench="service", programs=("ign-coordinator", "ignctl", "s3-endpoint"),
    ),
]
