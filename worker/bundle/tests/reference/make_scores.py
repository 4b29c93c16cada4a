"""Writes scores.json: SSIM by scikit-image and LDR-FLIP by NVIDIA's flip-evaluator for the image pairs beside it.

Run once; the results are committed, so the tests need no Python:
    pip install scikit-image==0.26.0 flip-evaluator==1.7 pillow numpy
    python make_scores.py
"""

import json
import pathlib

import flip_evaluator
import numpy as np
from PIL import Image
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity

here = pathlib.Path(__file__).parent
rng = np.random.default_rng(7)
W, H = 53, 37


def smooth(h, w):
    y, x = np.mgrid[0:h, 0:w]
    return np.stack(
        [127 + 90 * np.sin(x / 5 + y / 9), 127 + 100 * np.cos(x / 7 - y / 4), 40 + 3 * (x + y) % 200], axis=-1
    )


target = np.clip(smooth(H, W), 0, 255).astype(np.uint8)
target[8:20, 30:45] = (250, 250, 245)
pairs = {
    "noise": np.clip(target + rng.normal(0, 9, target.shape), 0, 255).astype(np.uint8),
    "shift": np.roll(target, (1, 2), axis=(0, 1)),
    "dark": (target * 0.8).astype(np.uint8),
    "colour": target[..., ::-1].copy(),
}
Image.fromarray(target).save(here / "target.png")
scores = {}
for name, image in pairs.items():
    Image.fromarray(image).save(here / f"{name}.png")
    _, flip, _ = flip_evaluator.evaluate(
        target.astype(np.float32) / 255, image.astype(np.float32) / 255, "LDR", inputsRGB=True, applyMagma=False
    )
    scores[name] = {
        "mse": float(mean_squared_error(target.astype(float), image.astype(float))),
        "psnr": float(peak_signal_noise_ratio(target, image, data_range=255)),
        "ssim": float(
            structural_similarity(
                target,
                image,
                gaussian_weights=True,
                sigma=1.5,
                use_sample_covariance=False,
                data_range=255,
                channel_axis=2,
            )
        ),
        "flip": float(flip),
    }
(here / "scores.json").write_text(json.dumps(scores, indent=2) + "\n")
