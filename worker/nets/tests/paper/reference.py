"""The paper's networks, losses and training steps in PyTorch, written from the paper alone, and what they compute.

Image-guided Neural Object Rendering (Thies et al. 2020), Sec. "EffectsNet", "CompositionNet", "Training"; the
discriminator and its loss from Pix2Pix (Isola et al. 2017), with which the paper shares them.

Inputs and weights are numbers that a formula makes from names (`stream`), the same here and in main.rs; of the results,
digests are kept: the norm of each tensor and some of its entries. All in float64: what differs is not rounding.

    pip install torch==2.11.0 numpy safetensors && python reference.py expected.safetensors
"""

import sys

import numpy as np
import torch
from safetensors.numpy import save_file
from torch import nn
from torch.nn import functional as F

BATCH, HEIGHT, WIDTH, K = 2, 64, 128, 4
STEPS = 3
SAMPLES = 24


def stream(name, shape, low=-1.0, high=1.0):
    """Uniform in [low, high): splitmix64 of FNV-1a of the name plus the entry's number, its upper 24 bits."""
    with np.errstate(over="ignore"):
        state = np.uint64(0xCBF29CE484222325)
        for byte in name.encode():
            state = (state ^ np.uint64(byte)) * np.uint64(0x100000001B3)
        z = state + np.arange(1, np.prod(shape) + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    unit = (z >> np.uint64(40)).astype(np.float32) / np.float32(1 << 24)
    return torch.from_numpy((np.float32(low) + unit * np.float32(high - low)).reshape(shape)).double()


class UNet(nn.Module):
    """Six 4x4 convolutions of stride 2, mirrored by transposed ones; skips; a last 4x4 convolution of stride 1."""

    def __init__(self, inputs, widths, slope):
        super().__init__()
        self.slope = slope
        self.levels = len(widths)
        before = [inputs] + widths[:-1]
        for level, (a, b) in enumerate(zip(before, widths)):
            self.add_module(f"down{level}", nn.Conv2d(a, b, 4, stride=2, padding=1))
            self.add_module(f"down{level}_norm", nn.BatchNorm2d(b))
        a = widths[-1]
        for level in reversed(range(self.levels)):
            b = widths[max(level - 1, 0)]
            self.add_module(f"up{level}", nn.ConvTranspose2d(a, b, 4, stride=2, padding=1))
            self.add_module(f"up{level}_norm", nn.BatchNorm2d(b))
            a = 2 * b if level > 0 else b
        self.head = nn.Conv2d(a, 3, 4, stride=1)

    def forward(self, x):
        layer = self.get_submodule
        skips = []
        for level in range(self.levels):
            x = F.leaky_relu(layer(f"down{level}_norm")(layer(f"down{level}")(x)), self.slope)
            skips.append(x)
        for level in reversed(range(self.levels)):
            x = F.relu(layer(f"up{level}_norm")(layer(f"up{level}")(x)))
            if level > 0:
                x = torch.cat([x, skips[level - 1]], dim=1)
        return torch.sigmoid(self.head(F.pad(x, (1, 2, 1, 2))))


class PatchGan(nn.Module):
    """C64-C128-C256-C512 and one value per patch; no normalisation after the first; leaky ReLU of 0.2."""

    def __init__(self, inputs):
        super().__init__()
        channels = [inputs, 64, 128, 256, 512]
        for index in range(4):
            stride = 2 if index < 3 else 1
            conv = nn.Conv2d(channels[index], channels[index + 1], 4, stride=stride, padding=1)
            self.add_module(f"conv{index}", conv)
            if index > 0:
                self.add_module(f"norm{index}", nn.BatchNorm2d(channels[index + 1]))
        self.head = nn.Conv2d(512, 1, 4, padding=1)

    def forward(self, condition, image):
        x = torch.cat([condition, image], dim=1)
        for index in range(4):
            x = self.get_submodule(f"conv{index}")(x)
            if index > 0:
                x = self.get_submodule(f"norm{index}")(x)
            x = F.leaky_relu(x, 0.2)
        return self.head(x)


def filled(network, prefix):
    """The network with values of the formula."""
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            full = prefix + name
            if name.endswith("num_batches_tracked"):
                continue
            if tensor.dim() > 1:
                bound = float(np.float32(np.sqrt(6.0 / (tensor.numel() / tensor.shape[0]))))
                tensor.copy_(stream(full, tensor.shape, -bound, bound))
            elif "norm" in name and name.endswith("weight") or name.endswith("running_var"):
                tensor.copy_(stream(full, tensor.shape, 0.75, 1.25))
            else:
                tensor.copy_(stream(full, tensor.shape, -0.125, 0.125))
    return network


def effects_net():
    return filled(UNet(9, [32, 32, 64, 128, 256, 512], 0.0), "effects.")


def composition_net():
    return filled(UNet(3 * K + 2 * K + 3, [64, 64, 128, 128, 256, 256], 0.2), "composition.")


def discriminator():
    return filled(PatchGan(3 * K + 2 * K + 3 + 3), "discriminator.")


# What the networks see.
geometry = stream("geometry", (BATCH, 9, HEIGHT, WIDTH))
warped = stream("warped", (BATCH, 5 * K + 3, HEIGHT, WIDTH))
# An image times its coverage lies between the two kinds of truth: the l1 norm has no kink nearby.
coverage = stream("coverage", (BATCH, 1, HEIGHT, WIDTH), 0.0, 0.5)
truth = stream("truth", (BATCH, 3, HEIGHT, WIDTH), 0.5, 1.0)
truth = truth * (stream("bright", truth.shape) > 0)
# The Siamese pair: 3,000 pixels of p show the surface; each lies between four pixels of q, with weights that are 0 where
# an occluder hides them.
colors = stream("colors", (2, HEIGHT * WIDTH, 3), 0.0, 1.0)
surface = (stream("surface", (3000,), 0.0, HEIGHT * WIDTH)).long()
tap_pixels = (stream("tap_pixels", (3000, 4), 0.0, HEIGHT * WIDTH)).long()
tap_weights = stream("tap_weights", (3000, 4), 0.0, 0.25)


def siamese_loss(net):
    """Sec. "Self-supervised Training": || M o [(I_p - E_p) - W(I_q - E_q)] ||_2 + 0.01 |E|_1, per value."""
    effects_p, effects_q = (e.flatten(1).T for e in net(geometry))
    diffuse_p = (colors[0] - effects_p)[surface]
    diffuse_q = colors[1] - effects_q
    seen = tap_weights.sum(1, keepdim=True)
    warped_q = torch.einsum("pt,ptc->pc", tap_weights, diffuse_q[tap_pixels]) / seen.clamp_min(1e-3)
    mask = (seen > 0.5).double()
    squared = ((mask * (diffuse_p - warped_q)) ** 2).sum() / (3 * mask.sum())
    # The floor keeps the root differentiable at 0.
    distance = torch.sqrt(squared + 1e-8)
    return distance + 0.01 * 0.5 * (effects_p.abs().mean() + effects_q.abs().mean())


def cross_entropy(logits, real):
    return F.binary_cross_entropy_with_logits(logits, torch.full_like(logits, float(real)))


def critic_loss(critic, image):
    fake, real = critic(warped, image.detach()), critic(warped, truth)
    return 0.5 * (cross_entropy(fake, False) + cross_entropy(real, True))


def painter_loss(critic, image):
    return 1.0 * F.l1_loss(image, truth) + 0.01 * cross_entropy(critic(warped, image), True)


def adam(network):
    return torch.optim.Adam(network.parameters(), lr=0.001, betas=(0.9, 0.999), eps=1e-8)


results = {}


def keep(name, tensor, samples=SAMPLES):
    """The norm of a tensor, and its entries at even steps from the first."""
    flat = tensor.detach().flatten()
    entries = flat[:: max(flat.numel() // samples, 1)]
    results[name] = torch.cat([flat.norm()[None], entries]).numpy()


def keep_gradients(case, prefix, network):
    for name, parameter in network.named_parameters():
        keep(f"{case}/{prefix}{name}", parameter.grad)


def keep_state(case, prefix, network):
    for name, tensor in network.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            keep(f"{case}/{prefix}{name}", tensor)


def main(out):
    torch.set_default_dtype(torch.float64)
    with torch.no_grad():
        keep("forward/effects", effects_net().eval()(geometry), 500)
        keep("forward/composition", composition_net().eval()(warped), 500)
        keep("forward/discriminator", discriminator().eval()(warped, truth), 500)

    net = effects_net().train()
    optimiser = adam(net)
    losses = []
    for step in range(STEPS):
        optimiser.zero_grad()
        loss = siamese_loss(net)
        loss.backward()
        if step == 0:
            keep_gradients("effects_gradient", "effects.", net)
        optimiser.step()
        losses.append(loss.detach())
    keep("losses/effects", torch.stack(losses))
    keep_state("effects_trained", "effects.", net)

    painter, critic = composition_net().train(), discriminator().train()
    painter_adam, critic_adam = adam(painter), adam(critic)
    losses = []
    for step in range(STEPS):
        image = painter(warped) * coverage
        critic_adam.zero_grad()
        critic_loss(critic, image).backward()
        if step == 0:
            keep_gradients("discriminator_gradient", "discriminator.", critic)
        critic_adam.step()
        painter_adam.zero_grad()
        loss = painter_loss(critic, image)
        loss.backward()
        if step == 0:
            keep_gradients("composition_gradient", "composition.", painter)
        painter_adam.step()
        losses.append(loss.detach())
    keep("losses/composition", torch.stack(losses))
    keep_state("composition_trained", "composition.", painter)
    keep_state("discriminator_trained", "discriminator.", critic)
    save_file(results, out)


if __name__ == "__main__":
    main(sys.argv[1])
