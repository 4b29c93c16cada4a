"""Training steps or frames of one network in eager PyTorch, from the weights and inputs that our side exported.

The paper's networks are those of `worker/nets/tests/paper/reference.py`; the networks of preset `standard` are written here
in the same way: modules, `torch.optim.Adam`, Muon as it was published, gradients clipped by `clip_grad_norm_`, an `AveragedModel`.
"""

import json
import math
import os
import sys
import time

import peer
import torch
from safetensors.torch import load_file
from torch import nn
from torch.nn import functional as F
from torch.nn.utils import clip_grad_norm_
from torch.optim.swa_utils import AveragedModel

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))))
sys.path.insert(0, os.path.join(ROOT, "worker", "nets", "tests", "paper"))

from reference import PatchGan, UNet, cross_entropy  # noqa: E402

# Slow enough that both sides agree after many steps on random images.
RATE = 1e-4
WARM_UP = 2
BATCHES = 4


def filled(network, tensors, prefix):
    """The network with our side's weights."""
    state = {name: tensors[prefix + name] for name in network.state_dict() if prefix + name in tensors}
    missing = network.load_state_dict(state, strict=False).missing_keys
    assert all(name.endswith("num_batches_tracked") for name in missing), missing
    return network


class Muon(torch.optim.Optimizer):
    """Momentum with its singular values brought near to one (Jordan et al. 2024)."""

    def __init__(self, parameters, lr):
        super().__init__(parameters, {"lr": lr})

    @torch.no_grad()
    def step(self):
        for group in self.param_groups:
            for weight in group["params"]:
                state = self.state[weight]
                momentum = state.setdefault("momentum", torch.zeros_like(weight))
                momentum.lerp_(weight.grad, 0.05)
                x = weight.grad.lerp(momentum, 0.95).flatten(1)
                x = x / x.norm().clamp_min(1e-15)
                for _ in range(5):
                    a = x @ x.T
                    x = 3.4445 * x + (-4.7750 * a + 2.0315 * a @ a) @ x
                weight.sub_(x.view_as(weight), alpha=0.8 * math.sqrt(x.shape[1]) * group["lr"])


class Averaged:
    """Muon for wide matrices but the last layer's and Adam for the rest, gradients clipped, an average of the weights that
    forgets its start fast."""

    def __init__(self, network, last):
        self.network = network
        named = list(network.named_parameters())

        def wide(name, weight):
            return weight.dim() >= 2 and not name.startswith(last) and weight.shape[0] ** 2 <= weight.numel()

        matrices = [weight for name, weight in named if wide(name, weight)]
        others = [weight for name, weight in named if not wide(name, weight)]
        self.optimizers = [torch.optim.Adam(others, lr=RATE), Muon(matrices, lr=RATE)]
        self.steps = 0
        self.average = AveragedModel(network, multi_avg_fn=self.average_into)
        self.average.update_parameters(network)

    def average_into(self, averages, weights, _):
        decay = min(0.995, (1 + self.steps) / (10 + self.steps))
        torch._foreach_lerp_(averages, weights, 1 - decay)

    def descend(self, loss):
        self.network.zero_grad()
        loss.backward()
        clip_grad_norm_(self.network.parameters(), 1.0)
        for optimizer in self.optimizers:
            optimizer.step()
        self.steps += 1
        self.average.update_parameters(self.network)
        return loss.item()


# ------------------------------------------------------------------------------------------------ the paper's networks


def effects_net(tensors):
    return filled(UNet(9, [32, 32, 64, 128, 256, 512], 0.0), tensors, "effects.")


def composition_net(tensors):
    return filled(UNet(23, [64, 64, 128, 128, 256, 256], 0.2), tensors, "composition.")


def train_paper_effects(t):
    net = effects_net(t).train()
    adam = torch.optim.Adam(net.parameters(), lr=RATE)

    def step(_):
        effects_p, effects_q = (e.flatten(1).T for e in net(t["geometry"]))
        diffuse_p = (t["colors"][0] - effects_p)[t["surface"]]
        diffuse_q = t["colors"][1] - effects_q
        seen = t["tap_weights"].sum(1, keepdim=True)
        warped_q = (t["tap_weights"][:, :, None] * diffuse_q[t["tap_pixels"]]).sum(1) / seen.clamp_min(1e-3)
        mask = (seen > 0.5).float()
        squared = ((mask * (diffuse_p - warped_q)) ** 2).sum() / (3 * mask.sum()).clamp_min(1)
        loss = torch.sqrt(squared + 1e-8) + 0.005 * (effects_p.abs().mean() + effects_q.abs().mean())
        adam.zero_grad()
        loss.backward()
        adam.step()
        return loss.item()

    return step


def train_paper_composition(t):
    painter = composition_net(t).train()
    critic = filled(PatchGan(26), t, "discriminator.").train()
    painter_adam = torch.optim.Adam(painter.parameters(), lr=RATE)
    critic_adam = torch.optim.Adam(critic.parameters(), lr=RATE)

    def step(_):
        image = painter(t["input"]) * t["coverage"]
        fake, real = critic(t["input"], image.detach()), critic(t["input"], t["truth"])
        critic_adam.zero_grad()
        (0.5 * (cross_entropy(fake, False) + cross_entropy(real, True))).backward()
        critic_adam.step()
        loss = F.l1_loss(image, t["truth"]) + 0.01 * cross_entropy(critic(t["input"], image), True)
        painter_adam.zero_grad()
        loss.backward()
        painter_adam.step()
        return loss.item()

    return step


# ------------------------------------------------------------------------------------- the networks of preset `standard`


def frequency_code(x, octaves):
    angles = [x * (math.pi * 2**octave) for octave in range(octaves)]
    return torch.cat([x, *(f(angle) for angle in angles for f in (torch.sin, torch.cos))], 1)


class PointEffects(nn.Module):
    """A perceptron per surface point: position, normal, reflected direction and cosine to light that is added."""

    def __init__(self):
        super().__init__()
        widths = [52, 64, 64, 64, 64, 3]
        for index, (a, b) in enumerate(zip(widths, widths[1:])):
            self.add_module(f"layer{index}", nn.Linear(a, b))

    def forward(self, points, normals, to_viewer):
        cosine = (to_viewer * normals).sum(1, keepdim=True)
        reflection = 2 * cosine * normals - to_viewer
        x = torch.cat([frequency_code(points, 3), normals, frequency_code(reflection, 4), cosine], 1)
        for index in range(4):
            x = F.relu(self.get_submodule(f"layer{index}")(x))
        return F.softplus(self.layer4(x))


def linear_from_srgb(srgb):
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear):
    inside = linear.clamp(0, 1)
    high = inside.clamp_min(0.0031308) ** (1 / 2.4) * 1.055 - 0.055
    return torch.where(inside <= 0.0031308, inside * 12.92, high) + (linear - inside) * 0.01


def directions(centers, points):
    d = centers - points
    return d / d.norm(dim=1, keepdim=True).clamp_min(1e-9)


def taps(t, centers, size, points, normals, view):
    """Where each point lies in its other view: four pixels, and weights that are 0 where the view does not see it."""
    width, height = size
    pose, k = t["pose"][view], t["intrinsics"][view]
    in_camera = (pose[:, :, :3] * points[:, None]).sum(2) + pose[:, :, 3]
    z = in_camera[:, 2]
    z_safe = z.clamp_min(1e-4)
    limit = 4.0 * max(width, height)
    u = (in_camera[:, 0] / z_safe * k[:, 0] + k[:, 2]).clamp(-limit, limit)
    v = (in_camera[:, 1] / z_safe * k[:, 1] + k[:, 3]).clamp(-limit, limit)
    to_source = centers[view] - points
    cosine = (to_source * normals).sum(1) / to_source.norm(dim=1).clamp_min(1e-9)
    facing = ((cosine - 0.05) / 0.2).clamp(0, 1)
    cosine = cosine.clamp(0.1, 1)
    bias = z_safe / k[:, 0] * ((1 - cosine**2).clamp_min(0).sqrt() / cosine + 1) * 1.5
    x, y = u - 0.5, v - 0.5
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    x0, y0 = x0.long(), y0.long()
    indices, weights = [], []
    for dx, dy in [(0, 0), (1, 0), (0, 1), (1, 1)]:
        xi, yi = x0 + dx, y0 + dy
        inside = (xi >= 0) & (xi < width) & (yi >= 0) & (yi < height)
        index = view * (width * height) + yi.clamp(0, height - 1) * width + xi.clamp(0, width - 1)
        d = t["depth"][index]
        usable = inside & (z > 1e-4) & (d > 0) & (z <= d + bias) & (z >= d - 4 * bias)
        weights.append((fx if dx else 1 - fx) * (fy if dy else 1 - fy) * usable)
        indices.append(index)
    return torch.stack(indices, 1), torch.stack(weights, 1) * (facing > 0)[:, None], facing


def train_point_effects(t):
    net = filled(PointEffects(), t, "effects.")
    trainee = Averaged(net, last="layer4")
    side = math.isqrt(t["depth"].numel() // t["pose"].shape[0])
    centers = -(t["pose"][:, :, :3].mT @ t["pose"][:, :, 3:])[:, :, 0]

    def robust(difference):
        return (difference**2 + 1e-4).sqrt()

    def step(turn):
        pick, other = t["pick"][turn % BATCHES], t["other"][turn % BATCHES]
        points, normals, views = t["points"][pick], t["normals"][pick], t["views"][pick]
        index, weight, facing = taps(t, centers, (side, side), points, normals, other)
        rows = ((weight.sum(1) > 0.9) & (facing > 0.3) & (views != other)).nonzero()[:, 0]
        points, normals, color_here = points[rows], normals[rows], t["colors"][pick[rows]]
        index, weight = index[rows], weight[rows]
        weight = weight * t["source_alpha"][index].float() / 255
        total = weight.sum(1, keepdim=True)
        color_there = (t["source_colors"][index].float() / 255 * weight[:, :, None]).sum(1) / total.clamp_min(1e-3)
        sound = (total > 0.9).float()
        here = net(points, normals, directions(centers[views[rows]], points))
        there = net(points, normals, directions(centers[other[rows]], points))
        bare_here = linear_from_srgb(color_here) - here
        bare_there = linear_from_srgb(color_there) - there
        error_here = robust(srgb_from_linear(bare_there + here) - color_here) * (color_there < 0.98)
        error_there = robust(srgb_from_linear(bare_here + there) - color_there) * (color_here < 0.98)
        loss = ((error_here + error_there) * sound).sum() / (sound.sum() * 6).clamp_min(1)
        return trainee.descend(loss + 0.005 * (here.abs().mean() + there.abs().mean()))

    return step


class Blend(nn.Module):
    """Softmax weights over the K warped views and one generated layer, per pixel."""

    WIDTHS = [32, 48, 64, 96]

    def __init__(self, k):
        super().__init__()
        w = self.WIDTHS
        self.k = k
        self.stem = nn.Conv2d(5 * k + 13, w[0], 3, padding=1)
        for i in range(1, len(w)):
            self.add_module(f"down{i}a", nn.Conv2d(w[i - 1], w[i], 4, stride=2, padding=1))
            self.add_module(f"down{i}b", nn.Conv2d(w[i], w[i], 3, padding=1))
            self.add_module(f"up{i}a", nn.Conv2d(w[i], w[i - 1], 3, padding=1))
            self.add_module(f"up{i}b", nn.Conv2d(2 * w[i - 1], w[i - 1], 3, padding=1))
        self.head = nn.Conv2d(w[0], k + 4, 3, padding=1)

    def forward(self, candidates, prior, visibility, target):
        base = (candidates * prior[:, :, None]).sum(1)
        seen = (visibility > 0).float()
        differences = (candidates - base[:, None]) * seen[:, :, None]
        x = torch.cat([differences.flatten(1, 2) * 4, base, prior, visibility, target], 1)
        layer = self.get_submodule
        levels = range(1, len(self.WIDTHS))
        x = F.leaky_relu(self.stem(x), 0.1)
        skips = []
        for i in levels:
            skips.append(x)
            x = F.leaky_relu(layer(f"down{i}a")(x), 0.1)
            x = x + F.leaky_relu(layer(f"down{i}b")(x), 0.1)
        for i in reversed(levels):
            skip = skips.pop()
            grown = F.interpolate(layer(f"up{i}a")(x), size=skip.shape[2:], mode="nearest")
            x = F.leaky_relu(layer(f"up{i}b")(torch.cat([F.leaky_relu(grown, 0.1), skip], 1)), 0.1)
        out = self.head(x)
        logits = (prior + 1e-4).log() + out[:, : self.k] + (seen - 1) * 1e4
        weights = torch.cat([logits, out[:, self.k : self.k + 1] - 4], 1).softmax(1)
        generated = base + out[:, self.k + 1 :]
        return (candidates * weights[:, : self.k, None]).sum(1) + generated * weights[:, self.k :]


def blend_net(t):
    return filled(Blend(t["prior"].shape[1]), t, "composition.")


def blend_input(t):
    return t["candidates"], t["prior"], t["visibility"], t["target"]


def train_blend(t):
    net = blend_net(t)
    trainee = Averaged(net, last="head")

    def step(_):
        difference = net(*blend_input(t)) * t["coverage"] - t["truth"]
        covered = t["coverage"].sum().clamp_min(1) * 3
        squared = difference**2
        return trainee.descend(((squared + 1e-6).sqrt().sum() + squared.sum() * 4) / covered)

    return step


# ------------------------------------------------------------------------------------------------------------------ runs


def frames(network, *inputs):
    @torch.no_grad()
    def frame(_):
        return network(*inputs).mean().item()

    return frame


WORK = {
    ("paper_effects", "train"): train_paper_effects,
    ("paper_effects", "render"): lambda t: frames(effects_net(t).eval(), t["geometry"]),
    ("paper_composition", "train"): train_paper_composition,
    ("paper_composition", "render"): lambda t: frames(composition_net(t).eval(), t["input"]),
    ("point_effects", "train"): train_point_effects,
    ("point_effects", "render"): lambda t: frames(
        filled(PointEffects(), t, "effects."), t["points"], t["normals"], t["to_viewer"]
    ),
    ("blend", "train"): train_blend,
    ("blend", "render"): lambda t: frames(blend_net(t), *blend_input(t)),
}


def main():
    options = peer.arguments()
    torch.set_num_threads(options.threads)
    case = peer.load(options.data, "case.json")
    once = WORK[case["net"], case["work"]](load_file(os.path.join(options.data, "tensors.safetensors")))
    started = time.perf_counter()
    for turn in range(WARM_UP):
        once(turn)
    prepare_secs = time.perf_counter() - started
    started = time.perf_counter()
    for turn in range(WARM_UP, WARM_UP + options.views):
        figure = once(turn)
    secs = time.perf_counter() - started
    peer.report(items=options.views, secs=secs, prepare_secs=prepare_secs, check={"figure": figure})


main()
