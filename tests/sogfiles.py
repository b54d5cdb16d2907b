"""SOG files built by hand, independently of nanogs' own writer."""

import io
import json
import zipfile

import numpy as np
from PIL import Image

RAMP = [i / 128 - 1 for i in range(256)]  # a codebook whose entries are easy to tell


def webp(rows, width=4, **options):
    """Encode bytes (N, C) as the texels of a lossless WebP file, padded with zeros."""
    rows = np.array(rows, np.uint8)
    height = max(4, -(-len(rows) // width))
    texels = np.zeros((height * width, 4), np.uint8)
    texels[: len(rows), : rows.shape[1]] = rows
    if rows.shape[1] == 3:
        texels[:, 3] = 255
    file = io.BytesIO()
    options = {"lossless": True, "exact": True} | options
    Image.fromarray(texels.reshape(height, width, 4)).save(file, "WEBP", **options)
    return file.getvalue()


def textures():
    """Return the textures of three splats."""
    return {
        "means_l.webp": webp([[0, 0, 0], [255, 255, 255], [1, 2, 3]]),
        "means_u.webp": webp([[0, 0, 0], [255, 255, 255], [128, 128, 128]]),
        "quats.webp": webp([[255, 0, 127, 252], [128, 128, 128, 255], [1, 2, 3, 7]]),
        "scales.webp": webp([[0, 1, 2], [253, 254, 255], [9, 9, 9]]),
        "sh0.webp": webp([[10, 20, 30, 0], [40, 50, 60, 255], [0, 128, 255, 51]]),
    }


def meta(**more):
    bounds = {"mins": [-1.0, 0.0, 1.0], "maxs": [1.0, 0.0, 2.0]}
    return {
        "version": 2,
        "count": 3,
        "means": {**bounds, "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
        "scales": {"codebook": RAMP, "files": ["scales.webp"]},
        "sh0": {"codebook": RAMP, "files": ["sh0.webp"]},
    } | more


def meta_1(**more):
    tables = meta()
    del tables["version"], tables["count"]
    tables["means"]["shape"] = [3, 3]
    tables["scales"] = {"mins": [-1, -2, -3], "maxs": [0, 0, 0], "files": ["scales.webp"]}
    low, high = [-1, -1, -1, -5], [1, 1, 1, 5]
    tables["sh0"] = {"mins": low, "maxs": high, "files": ["sh0.webp"]}
    return tables | more


def palette(degree, entries):
    """Make a texture of centroids, whose texels hold their entry's number, and one of labels."""
    coefficients = (degree + 1) ** 2 - 1
    rows = np.repeat(np.arange(entries), coefficients)[:, None].repeat(3, axis=1)
    rows[:, 1] += 1  # green
    rows[:, 2] = np.arange(len(rows)) % coefficients  # blue
    picture = webp(rows, width=64 * coefficients)
    return {"shN_centroids.webp": picture, "shN_labels.webp": webp([[0, 0], [1, 0], [2, 0]])}


def files(described=None, **replaced):
    """Return all files of a model by name."""
    described = meta() if described is None else described
    text = described if isinstance(described, bytes) else json.dumps(described).encode()
    return textures() | {"meta.json": text} | replaced


def folder(path, contents):
    path.mkdir(parents=True, exist_ok=True)
    for name, data in contents.items():
        (path / name).write_bytes(data)
    return path / "meta.json"


def bundle(path, contents, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as file:
        for name, data in contents.items():
            file.writestr(name, data)
    return path
