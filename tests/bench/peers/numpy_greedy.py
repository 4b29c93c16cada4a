"""The choice of references as plain greedy in NumPy: every gain of every view, anew for every choice.

The same arithmetic in the same order as `select.rs` (f32 chords, f64 sums over samples, then over targets), so the
choices must be equal.
"""

import time

import numpy
import peer

REFERENCES = 20
COVERED_SHARE = 0.05
UNSEEN_COST = numpy.float32(2)
DUPLICATE_SHARE = 0.01


def main():
    options = peer.arguments()
    data = peer.load(options.data, "candidates.json")
    centers = numpy.array(data["centers"])
    samples = numpy.array(data["samples"])
    words = numpy.array(data["seen"], numpy.uint64)
    bits = numpy.unpackbits(words.view(numpy.uint8), axis=1, bitorder="little")
    seen = bits[:, : len(samples)].astype(bool)
    quality = numpy.array(data["quality"])
    cosines = numpy.array(data["cosines"], numpy.float32).reshape(len(samples), -1)

    started = time.perf_counter()

    def rays(view):
        ray = centers[view] - samples
        length = numpy.sqrt(ray[:, 0] * ray[:, 0] + ray[:, 1] * ray[:, 1] + ray[:, 2] * ray[:, 2])
        return (ray * (1 / length)[:, None]).astype(numpy.float32)

    targets = numpy.stack([rays(target) for target in data["targets"]], axis=1)

    def chords(view):
        """[sample that the view sees][target]"""
        difference = rays(view)[seen[view], None] - targets[seen[view]]
        x, y, z = difference[..., 0], difference[..., 1], difference[..., 2]
        return numpy.sqrt(x * x + y * y + z * z)

    def gain(view):
        saved = numpy.maximum(costs[seen[view]] - chords(view), 0)
        return sum((cosines[seen[view]] * saved).sum(axis=0, dtype=numpy.float64))

    middle = samples.mean(axis=0)
    distance = numpy.linalg.norm(centers - middle, axis=1)

    def near_duplicate(a, b):
        return numpy.linalg.norm(centers[a] - centers[b]) <= DUPLICATE_SHARE * min(distance[a], distance[b])

    costs = numpy.full((len(samples), len(data["targets"])), UNSEEN_COST)
    uncovered = numpy.ones(len(samples), bool)
    left, chosen, covering = list(range(len(centers))), [], True
    while len(chosen) < REFERENCES and left:
        fresh = [v for v in left if not any(near_duplicate(v, other) for other in chosen)] or left
        pick = None
        if covering:
            counts = (seen[fresh] & uncovered).sum(axis=1)
            best = max(range(len(fresh)), key=lambda at: (counts[at], quality[fresh[at]], -fresh[at]))
            covering = counts[best] > COVERED_SHARE * len(samples)
            pick = fresh[best] if covering else None
        if pick is None:
            pick = max(fresh, key=lambda view: (gain(view), quality[view], -view))
        chosen.append(pick)
        left.remove(pick)
        uncovered &= ~seen[pick]
        costs[seen[pick]] = numpy.minimum(costs[seen[pick]], chords(pick))
    peer.report(
        items=len(centers), secs=time.perf_counter() - started, prepare_secs=0.0, check={"chosen": chosen},
    )


main()
