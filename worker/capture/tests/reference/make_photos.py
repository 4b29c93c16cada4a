"""Writes the small pictures in photos/ and, beside each, the sRGB values that Pillow (with LittleCMS) and numpy get.

    pip install numpy pillow tifffile imagecodecs
    python make_photos.py

Each picture NAME.ext has NAME.ext.srgb: height * width * 3 little-endian unsigned 16-bit numbers, sRGB scaled to 65535.
"""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image, ImageCms

OUT = Path(__file__).parent / "photos"
W, H = 40, 24


def colors(width=W, height=H):
    """Smooth in hue and brightness, all of it well inside every gamut but the last columns: [h, w, 3] in [0, 1]."""
    x = (np.arange(width) + 0.5) / width
    y = (np.arange(height) + 0.5) / height
    x, y = np.meshgrid(x, y)
    rgb = np.stack([0.2 + 0.6 * x, 0.25 + 0.5 * y, 0.7 - 0.5 * x * y], -1)
    return 0.3 + 0.5 * rgb


def encode(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)


def decode(value):
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def expect(name, rgb):
    values = np.round(np.clip(rgb, 0, 1) * 65535).astype("<u2")
    (OUT / f"{name}.srgb").write_bytes(values.tobytes())


def profile(primaries, white, gamma=None):
    """A version 2 matrix profile; `gamma` None: the curve of sRGB in 1024 steps."""
    xyz = lambda x, y: np.array([x / y, 1.0, (1 - x - y) / y])
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    d50 = np.array([0.9642, 1.0, 0.8249])
    w = xyz(*white)
    p = np.stack([xyz(*q) for q in primaries], 1)
    m = p * np.linalg.solve(p, w)
    adapt = np.linalg.inv(bradford) @ np.diag((bradford @ d50) / (bradford @ w)) @ bradford
    m = adapt @ m
    fixed = lambda v: struct.pack(">i", round(v * 65536))
    if gamma is None:
        values = decode(np.linspace(0, 1, 1024))
        curve = b"curv" + bytes(4) + struct.pack(">I", 1024) + np.round(values * 65535).astype(">u2").tobytes()
    else:
        curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256)) + bytes(2)
    text = b"fixture\0"
    desc = b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67)
    tag = lambda v: b"XYZ " + bytes(4) + b"".join(fixed(c) for c in v)
    tags = [
        (b"desc", desc),
        (b"cprt", b"text" + bytes(4) + b"none\0"),
        (b"wtpt", tag(d50)),
        (b"rXYZ", tag(m[:, 0])),
        (b"gXYZ", tag(m[:, 1])),
        (b"bXYZ", tag(m[:, 2])),
        (b"rTRC", curve),
        (b"gTRC", curve),
        (b"bTRC", curve),
    ]
    table, body = struct.pack(">I", len(tags)), b""
    offset = 128 + 4 + 12 * len(tags)
    for name, data in tags:
        data += bytes(-len(data) % 4)
        table += name + struct.pack(">II", offset + len(body), len(data))
        body += data
    size = offset + len(body)
    header = struct.pack(">I4sI4s4s4s", size, bytes(4), 0x02100000, b"mntr", b"RGB ", b"XYZ ")
    header += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(4 + 4 + 4 + 4 + 8 + 4)
    header += fixed(0.9642) + fixed(1.0) + fixed(0.8249) + bytes(4)
    return header + bytes(128 - len(header)) + table + body


D65 = (0.3127, 0.3290)
P3 = profile([(0.68, 0.32), (0.265, 0.69), (0.15, 0.06)], D65)
ADOBE = profile([(0.64, 0.33), (0.21, 0.71), (0.15, 0.06)], D65, 563 / 256)
LINEAR = profile([(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)], D65, 1.0)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def by_littlecms(rgb8, icc):
    source = ImageCms.ImageCmsProfile(io.BytesIO(icc))
    image = Image.fromarray(rgb8)
    converted = ImageCms.profileToProfile(
        image, source, ImageCms.createProfile("sRGB"), renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC, outputMode="RGB"
    )
    return np.asarray(converted) / 255.0


def png(name, rgb, depth, chunks=()):
    """A PNG file with further chunks before the data; rgb in [0, 1], [h, w, channels]."""
    h, w, c = rgb.shape
    most = (1 << depth) - 1
    values = np.round(rgb * most).astype(">u2" if depth == 16 else "u1")
    rows = b"".join(b"\0" + row.tobytes() for row in values)
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    header = struct.pack(">IIBBBBB", w, h, depth, {1: 0, 3: 2, 4: 6}[c], 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header)
    data += b"".join(chunk(kind, body) for kind, body in chunks)
    (OUT / name).write_bytes(data + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b""))
    return values.astype(float) / most


def main():
    OUT.mkdir(exist_ok=True)
    rgb = colors()
    eight = np.round(rgb * 255).astype("u1")
    image = Image.fromarray(eight)

    # Colour profiles, in every container.
    for name, icc, save in [
        ("p3.webp", P3, dict(lossless=True)),
        ("adobe.png", ADOBE, {}),
        ("adobe.tiff", ADOBE, {}),
        ("linear_profile.tiff", LINEAR, {}),
        ("srgb_profile.png", SRGB, {}),
    ]:
        image.save(OUT / name, icc_profile=icc, **save)
        expect(name, eight / 255.0 if icc is SRGB else by_littlecms(eight, icc))
    # JPEG is lossy: what Pillow decodes is what LittleCMS converts.
    image.save(OUT / "p3.jpg", icc_profile=P3, quality=95, subsampling=0)
    expect("p3.jpg", by_littlecms(np.asarray(Image.open(OUT / "p3.jpg")), P3))

    # PNG without a profile.
    values = png("gamma_1.png", rgb, 16, [(b"gAMA", struct.pack(">I", 100000))])
    expect("gamma_1.png", encode(values))
    values = png("gamma_srgb.png", rgb, 8, [(b"gAMA", struct.pack(">I", 45455))])
    expect("gamma_srgb.png", values)
    values = png("sixteen.png", rgb, 16)
    expect("sixteen.png", values)
    # Display P3 by cICP: primaries 12, transfer of sRGB 13.
    values = png("cicp_p3.png", rgb, 8, [(b"cICP", bytes([12, 13, 0, 1]))])
    expect("cicp_p3.png", by_littlecms(np.round(values * 255).astype("u1"), P3))
    png("cicp_pq.png", rgb, 16, [(b"cICP", bytes([9, 16, 0, 1]))])

    # TIFF: depths, strips and tiles, compressions.
    sixteen = np.round(rgb * 65535).astype("u2")
    tifffile.imwrite(OUT / "strips_lzw.tiff", eight, photometric="rgb", rowsperstrip=5, compression="lzw", predictor=True)
    expect("strips_lzw.tiff", eight / 255.0)
    tifffile.imwrite(OUT / "tiles_deflate.tiff", sixteen, photometric="rgb", tile=(16, 16), compression="zlib")
    expect("tiles_deflate.tiff", sixteen / 65535.0)
    tifffile.imwrite(OUT / "packbits.tiff", eight, photometric="rgb", compression="packbits", byteorder=">")
    expect("packbits.tiff", eight / 255.0)
    light = decode(rgb).astype("f4")
    tifffile.imwrite(OUT / "float.tiff", light, photometric="rgb", compression="zlib")
    expect("float.tiff", rgb)
    grey = eight[..., 0]
    tifffile.imwrite(OUT / "grey.tiff", grey, photometric="minisblack")
    expect("grey.tiff", np.repeat(grey[..., None], 3, -1) / 255.0)
    Image.fromarray(eight).convert("CMYK").save(OUT / "cmyk.tiff")
    Image.fromarray(eight).convert("CMYK").save(OUT / "cmyk.jpg")
    palette = image.quantize(32)
    palette.save(OUT / "palette.png")
    expect("palette.png", np.asarray(palette.convert("RGB")) / 255.0)
    gray = image.convert("L")
    gray.save(OUT / "grey.jpg", quality=95)
    expect("grey.jpg", np.repeat(np.asarray(Image.open(OUT / "grey.jpg"))[..., None], 3, -1) / 255.0)

    # Alpha: straight in PNG and WebP, multiplied in TIFF with ExtraSamples 1.
    alpha = np.clip((np.arange(W) - 8) / 20, 0, 1)[None].repeat(H, 0)
    straight = np.dstack([eight, np.round(alpha * 255).astype("u1")])
    Image.fromarray(straight).save(OUT / "alpha.png")
    Image.fromarray(straight).save(OUT / "alpha.webp", lossless=True, exact=True)
    multiplied = np.round(np.dstack([rgb * alpha[..., None], alpha]) * 65535).astype("u2")
    tifffile.imwrite(OUT / "alpha.tiff", multiplied, photometric="rgb", extrasamples=["assocalpha"])
    for name in ["alpha.png", "alpha.webp", "alpha.tiff"]:
        covered = np.round(alpha * 255) / 255 if name != "alpha.tiff" else alpha
        expect(name, encode(decode(eight / 255.0 if name != "alpha.tiff" else rgb) * covered[..., None]))

    # Exif: an orientation that must not be applied, and Adobe RGB without a profile.
    exif = Image.Exif()
    exif[0x0112] = 6
    image.save(OUT / "turned.jpg", exif=exif, quality=95, subsampling=0)
    expect("turned.jpg", np.asarray(Image.open(OUT / "turned.jpg")) / 255.0)
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    image.save(OUT / "adobe_exif.jpg", exif=exif, quality=95, subsampling=0)
    expect("adobe_exif.jpg", by_littlecms(np.asarray(Image.open(OUT / "adobe_exif.jpg")), ADOBE))

    # Larger JPEG files for means over cells: every sampling of chroma, with restart markers, progressive and grey.
    y, x = np.mgrid[0:83, 0:117]
    busy = np.stack(
        [
            128 + 90 * np.sin(x / 3.1 + y / 17.0),
            128 + 60 * np.cos(y / 2.3) + 30 * np.sin(x / 7.0),
            128 + 50 * np.sin((x + 2 * y) / 5.0),
        ],
        -1,
    )
    noise = np.random.default_rng(7).normal(0, 12, busy.shape)
    busy = Image.fromarray(np.clip(busy + noise, 0, 255).astype("u1"))
    for name, options in [
        ("busy_444.jpg", dict(subsampling=0)),
        ("busy_422.jpg", dict(subsampling=1)),
        ("busy_420.jpg", dict(subsampling=2)),
        ("busy_restart.jpg", dict(subsampling=2, restart_marker_blocks=3)),
        ("busy_progressive.jpg", dict(subsampling=2, progressive=True)),
    ]:
        busy.save(OUT / name, quality=90, **options)
    busy.convert("L").save(OUT / "busy_grey.jpg", quality=90)


main()
