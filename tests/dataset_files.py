"""Write tiny data sets as other tools would, following the descriptions of their formats."""

import json
import struct

import numpy as np
from PIL import Image

MODEL_NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4}
# A rotation by 90 degrees about z: camera x is world -y, camera y is world x.
QUARTER = (0.5**0.5, 0.0, 0.0, -(0.5**0.5))


def colmap_camera(camera_id=1, model="PINHOLE", size=(80, 60), params=(70.0, 71.0, 39.0, 31.0)):
    return (camera_id, model, size, tuple(params))


def colmap_image(image_id, name, q=(1.0, 0.0, 0.0, 0.0), t=(0.0, 0.0, 4.0), camera_id=1, points=2):
    return (image_id, tuple(q), tuple(t), camera_id, name, points)


def nine_images():
    # Out of order on purpose: COLMAP numbers images as it registers them.
    order = (4, 0, 8, 2, 6, 1, 3, 7, 5)
    return [
        colmap_image(n + 1, f"img_{k}.png", QUARTER if k % 2 else (1, 0, 0, 0), (k, 0, 4), points=k)
        for n, k in enumerate(order)
    ]


def cameras_bin(cameras, numbers=MODEL_NUMBERS):
    out = struct.pack("<Q", len(cameras))
    for camera_id, model, (width, height), params in cameras:
        out += struct.pack("<IiQQ", camera_id, numbers.get(model, model), width, height)
        out += struct.pack(f"<{len(params)}d", *params)
    return out


def images_bin(images):
    out = struct.pack("<Q", len(images))
    for image_id, q, t, camera_id, name, points in images:
        out += struct.pack("<I4d3dI", image_id, *q, *t, camera_id) + name.encode() + b"\0"
        out += struct.pack("<Q", points)
        out += b"".join(struct.pack("<ddq", 1.5, 2.5, -1) for _ in range(points))
    return out


def cameras_txt(cameras):
    lines = ["# Camera list with one line of data per camera:", ""]
    for camera_id, model, (width, height), params in cameras:
        lines.append(" ".join(map(str, (camera_id, model, width, height, *params))))
    return "\n".join(lines) + "\n"


def images_txt(images):
    lines = ["# Image list with two lines of data per image:"]
    for image_id, q, t, camera_id, name, points in images:
        lines.append(" ".join(map(str, (image_id, *q, *t, camera_id, name))))
        lines.append(" ".join(["1.5 2.5 -1"] * points))
    return "\n".join(lines) + "\n"


def write_model(folder, cameras=None, images=None, encoding="bin"):
    cameras = [colmap_camera()] if cameras is None else cameras
    images = nine_images() if images is None else images
    folder.mkdir(parents=True, exist_ok=True)
    if encoding == "bin":
        (folder / "cameras.bin").write_bytes(cameras_bin(cameras))
        (folder / "images.bin").write_bytes(images_bin(images))
    else:
        (folder / "cameras.txt").write_text(cameras_txt(cameras))
        (folder / "images.txt").write_text(images_txt(images))
    return folder


def write_photo(path, size=(80, 60), colour=(255, 0, 0), mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, size, colour).save(path)
    return path


def write_capture(root, encoding="bin", folder="images", size=(80, 60), **model):
    write_model(root / "sparse" / "0", encoding=encoding, **model)
    for k in range(9):
        write_photo(root / folder / f"img_{k}.png", size, colour=(k, 0, 0))
    return root


# OpenGL camera-to-world: at (1, 2, 3), with the world's axes, so that it looks along world -z.
POSE = [[1.0, 0, 0, 1.0], [0, 1.0, 0, 2.0], [0, 0, 1.0, 3.0], [0, 0, 0, 1.0]]


def transforms(frames=None, **shared):
    frames = [{"file_path": "./test/r_0", "transform_matrix": POSE}] if frames is None else frames
    return {"camera_angle_x": 2 * float(np.arctan(0.5)), "frames": frames, **shared}


def write_json(path, document):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def trained_camera(**changes):
    entry = {
        "id": 0,
        "img_name": "r_0",
        "width": 80,
        "height": 60,
        "position": [1.0, 2.0, 3.0],
        "rotation": [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]],
        "fx": 70.0,
        "fy": 71.0,
    }
    return {**entry, **changes}
