"""Small complete files of every format that is read, and functions that damage them.

A seed is the files of a folder by name, the first of them the model's. A mutation is a function
that damages a seed: either the bytes on the disk or the content packed in them. In the second case
checksums and lengths around the content are corrected, so that the damage reaches the code that
comes after their checks.
"""

import base64
import functools
import gzip
import io as bytes_io
import json
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zstandard
from PIL import Image

import ksplatfiles
import lcc2files
import lccfiles
import radfiles
import sogfiles
import spzfiles
import torchfiles
from builders import random_splats
from damage import TEXT, change_json, mutate
from nanogs import io
from nanogs.io.gltf import packed_write as gltf_spz
from nanogs.splats import RenderMode
from plyfiles import BASE, ENCODINGS, ply, vertex

Files = dict[str, bytes]
Mutation = Callable[[np.random.Generator, Files], Files]


@dataclass(frozen=True)
class Format:
    """A format to damage: its seeds, and its mutations; one listed twice is twice as likely."""

    seeds: list[Files]
    mutations: list[Mutation]

    def damaged(self, rng):
        """Return the files of a damaged model."""
        files = self.seeds[rng.integers(len(self.seeds))]
        return self.mutations[rng.integers(len(self.mutations))](rng, files)


def write_files(folder, files):
    """Write files into a folder, and return the path of the first."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder / next(iter(files))


# --- mutations


def damage_any_file(rng, files):
    """Damage bytes of any one of the files."""
    name = list(files)[rng.integers(len(files))]
    return files | {name: mutate(rng, files[name], header=400, anywhere=0.5) or b"\0"}


def damage_first_file(rng, files):
    """Damage bytes and words of the first file, mostly in its header."""
    name = next(iter(files))
    return files | {name: mutate(rng, files[name], header=400, anywhere=0.3, text=TEXT) or b"\0"}


def whole_json(rng, files):
    """Damage values of the first JSON file."""
    name = next(name for name in files if name.endswith((".json", ".lcc", ".lcc2")))
    return files | {name: changed_json(rng, files[name])}


def changed_json(rng, data):
    return json.dumps(change_json(rng, json.loads(data))).encode()


def inside_gzip(rng, files):
    ((name, data),) = files.items()
    inner = mutate(rng, gzip.decompress(data), header=16, anywhere=0.5)
    return {name: gzip.compress(inner, 1, mtime=0)}


def inside_zstd(rng, files):
    """Damage a stream of `.spz` version 4, whose stated length is then corrected or not."""
    ((name, data),) = files.items()
    streams, (toc,) = data[15], struct.unpack_from("<I", data, 16)
    sizes = list(struct.iter_unpack("<QQ", data[toc : toc + 16 * streams]))
    offset, packed, chosen = toc + 16 * streams, b"", int(rng.integers(streams))
    table = b""
    for i, (size, expanded) in enumerate(sizes):
        stated = expanded
        stream = data[offset : offset + size]
        offset += size
        if i == chosen:
            inner = mutate(rng, zstandard.decompress(stream)) or b"\0"
            stream = zstandard.compress(inner)
            if rng.random() < 0.5:
                stated = len(inner)
        table += struct.pack("<QQ", len(stream), stated)
        packed += stream
    return {name: data[:toc] + table + packed}


def inside_zip(rng, files, deflate=0.5):
    """Damage a member of an archive, and pack it again."""
    ((name, data),) = files.items()
    out = bytes_io.BytesIO()
    method = zipfile.ZIP_DEFLATED if rng.random() < deflate else zipfile.ZIP_STORED
    with zipfile.ZipFile(bytes_io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", method) as new:
        members = old.namelist()
        chosen = rng.integers(len(members))
        for i, member in enumerate(members):
            content = old.read(member)
            new.writestr(member, _member(rng, member, content) if i == chosen else content)
    return {name: out.getvalue()}


def inside_stored_zip(rng, files):
    return inside_zip(rng, files, deflate=0.1)


def _member(rng, name, content):
    if name.endswith(".json") and rng.random() < 0.8:
        return changed_json(rng, content)
    if name.endswith(".webp") and rng.random() < 0.5:
        return texels(rng, content)
    return mutate(rng, content, header=128, anywhere=0.3) or b"\0"


def texels(rng, data):
    """Make another picture: other texels, another size, lossy, or an animation."""
    with Image.open(bytes_io.BytesIO(data)) as image:
        pixels = np.array(image.convert("RGBA"))
    pixels[rng.random(pixels.shape) < 0.1] = rng.integers(256)
    if rng.random() < 0.3:
        pixels = np.resize(pixels, (*rng.integers(1, 80, 2), 4))
    out = bytes_io.BytesIO()
    options = {"lossless": rng.random() < 0.9, "exact": True}
    if rng.random() < 0.1:
        options |= {"save_all": True, "append_images": [Image.fromarray(pixels[::-1])]}
    Image.fromarray(pixels).save(out, "WEBP", **options)
    return out.getvalue()


def one_texture(rng, files):
    """Replace one texture of a folder by another picture."""
    names = [name for name in files if name.endswith(".webp")]
    name = names[rng.integers(len(names))]
    return files | {name: texels(rng, files[name])}


def one_description(rng, files):
    """Damage values of any one JSON file of a folder."""
    names = [name for name in files if name.endswith(".json")]
    name = names[rng.integers(len(names))]
    return files | {name: changed_json(rng, files[name])}


def one_missing(rng, files):
    """Remove a file of a folder, or replace it by another."""
    names = [name for i, name in enumerate(files) if i]
    if not names:
        return damage_any_file(rng, files)
    name = names[rng.integers(len(names))]
    others = {other: data for other, data in files.items() if other != name}
    if rng.random() < 0.5:
        others[name] = files[names[rng.integers(len(names))]]
    return others


def inside_glb(rng, files):
    """Damage values of the JSON of a `.glb` file, and correct its lengths."""
    ((name, data),) = files.items()
    (length,) = struct.unpack_from("<I", data, 12)
    content = changed_json(rng, data[20 : 20 + length])
    content += b" " * (-len(content) % 4)
    rest = data[20 + length :]
    size = 20 + len(content) + len(rest)
    return {name: data[:8] + struct.pack("<II", size, len(content)) + b"JSON" + content + rest}


def inside_gltf(rng, files):
    """Damage values of the JSON of a `.gltf` file, except its `data:` URIs, or bytes in these."""
    name = next(iter(files))
    content = json.loads(files[name])
    uri = content["buffers"][0]["uri"]
    if uri.startswith("data:") and rng.random() < 0.3:
        head, _, data = uri.partition(",")
        body = mutate(rng, base64.b64decode(data), header=400, anywhere=0.5)
        content["buffers"][0]["uri"] = f"{head},{base64.b64encode(body).decode()}"
        return files | {name: json.dumps(content).encode()}
    content["buffers"][0]["uri"] = "data:"
    return files | {name: changed_json(rng, json.dumps(content)).replace(b"data:", uri.encode())}


def inside_packed_glb(rng, files):
    """Damage the packed content of a `.glb` file, and correct its lengths."""
    ((name, data),) = files.items()
    (length,) = struct.unpack_from("<I", data, 12)
    content = json.loads(data[20 : 20 + length])
    size = content["bufferViews"][0]["byteLength"]
    inner = gzip.decompress(data[28 + length : 28 + length + size])
    packed = gzip.compress(mutate(rng, inner, header=16, anywhere=0.5), 1, mtime=0)
    content["bufferViews"][0]["byteLength"] = content["buffers"][0]["byteLength"] = len(packed)
    return {name: glb(json.dumps(content).encode(), packed)}


def inside_rad(rng, files):
    """Damage the description of the file or of a chunk, or the packed content of a column."""
    name = next(iter(files))
    head, chunks = radfiles.parse_rad(files[name])
    chosen, kind = int(rng.integers(len(chunks))), rng.random()
    description, payload = chunks[chosen]
    if kind < 0.4:
        entry = description["properties"][rng.integers(len(description["properties"]))]
        columns = []
        for each in description["properties"]:
            data = radfiles.inflated(payload[each["offset"] : each["offset"] + each["bytes"]])
            data = mutate(rng, data, header=400, anywhere=0.5) if each is entry else data
            kept_entries = {k: v for k, v in each.items() if k not in ("offset", "bytes")}
            columns.append((kept_entries, data))
        others = {k: v for k, v in description.items() if k not in ("properties", "payloadBytes")}
        others = {k: others.pop(k) for k in ("count", "base")} | others
        changed = radfiles.chunk(columns, **others)
    else:
        description = change_json(rng, description) if kind < 0.7 else description
        start = radfiles.json_block(b"RADC", json.dumps(description).encode())
        changed = start + struct.pack("<Q", len(payload)) + payload
    parts = [
        changed if i == chosen else radfiles.json_block(b"RADC", t) + struct.pack("<Q", len(p)) + p
        for i, (t, p) in enumerate(chunks)
    ]
    if kind >= 0.7:
        head = change_json(rng, head)
        return files | {name: radfiles.json_block(b"RAD0", json.dumps(head).encode())
                        + b"".join(parts)}  # fmt: skip
    others = {k: v for k, v in head.items() if k not in ("chunks", "count")}
    return files | {name: radfiles.rad(parts, head["count"], **others)}


def glb(text, body):
    text, body = text + b" " * (-len(text) % 4), body + b"\0" * (-len(body) % 4)
    chunks = struct.pack("<I", len(text)) + b"JSON" + text
    chunks += struct.pack("<I", len(body)) + b"BIN\0" + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


# --- seeds


def saved(model, name, version=None):
    """Return the files that nanogs writes of a model, with those beside a `meta.json`."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, "model", name)
        target.parent.mkdir()
        if name == "meta.json":
            target.parent.rmdir()
        io.save(model, target, format_options={"spz_version": version} if version else {})
        return files_of(target)


def files_of(target):
    """Read a file, and all others of its folder; return them by their relative paths."""
    others = sorted(path for path in target.parent.rglob("*") if path.is_file())
    ordered = [target, *(path for path in others if path != target)]
    return {path.relative_to(target.parent).as_posix(): path.read_bytes() for path in ordered}


def models(degrees, counts=(3, 300)):
    """Yield models of some degrees, with infinite opacities and a render mode; one is larger."""
    for degree in degrees:
        for count in counts:
            model = random_splats(count, degree=degree, seed=degree)
            model.opacity_logits[0] = np.inf
            yield model
    yield replace(random_splats(40, degree=degrees[-1]), render_mode=RenderMode.MIP)
    yield random_splats(5_000, degree=degrees[-1])


def _plys():
    extras = {"label": np.arange(40, dtype=np.int32)}
    whole = [saved(model, "a.ply") for model in models((0, 3, 4))]
    whole += [saved(random_splats(40, extras=extras), "a.ply")]
    by_hand = ("vertex", vertex(3, [*BASE, "a"], {"a": "short"}))
    return whole + [{"a.ply": ply(by_hand, encoding=kind)} for kind in ENCODINGS]


def _spzs(version):
    if version >= 3:
        return [saved(model, "a.spz", version) for model in models((0, 2, 4))]
    rng = np.random.default_rng(version)
    out = []
    for degree, count in ((0, 3), (1, 40), (3, 200)):
        width = 3 * ((degree + 1) ** 2 - 1)
        rows = [
            spzfiles.row(rng.normal(0, 9, 3), alpha=int(rng.integers(256)),
                         sh=rng.integers(0, 256, width).tolist())
            for _ in range(count)
        ]  # fmt: skip
        out.append({"a.spz": spzfiles.encode(rows, version, degree=degree)})
    return out


def inflated(files):
    """Return the files without their gzip compression."""
    return {name: gzip.decompress(data) for name, data in files.items()}


def _ksplats():
    shapes = [((9, 4), degree, mode) for degree in (0, 1, 3) for mode in range(3)]
    shapes += [((5_000,), 3, 1)]
    return [
        {"a.ksplat": ksplatfiles.ksplat(
            *(ksplatfiles.section(n, mode, degree, seed=n) for n in counts), mode=mode)}
        for counts, degree, mode in shapes
    ]  # fmt: skip


def _sogs_1():
    names = ["shN_centroids.webp", "shN_labels.webp"]
    shn = {"shape": [3, 45], "mins": -1, "maxs": 1, "files": names}
    with_palette = sogfiles.files(sogfiles.meta_1(shN=shn), **sogfiles.palette(1, 3))
    return [_first(sogfiles.files(sogfiles.meta_1())), _first(with_palette)]


def _first(contents):
    """Return the same files with `meta.json` first."""
    return {"meta.json": contents["meta.json"]} | contents


def _bundles():
    out = [saved(model, "a.sog") for model in models((0, 3))]
    for contents in _sogs_1():
        file = bytes_io.BytesIO()
        sogfiles.bundle(file, contents)
        out.append({"a.sog": file.getvalue()})
    return out


def _checkpoints(suffix, content, **options):
    extra = [random_splats(5_000, degree=3)]
    whole = [*(random_splats(n, degree=d) for n in (3, 300) for d in (0, 3)), *extra]
    return [
        {f"a{suffix}": torchfiles.TorchFile(content(model), **options).bytes()} for model in whole
    ]


def _streamed():
    """Make streams of two levels in four models, one of them written by nanogs and larger."""
    out: Files = {}
    for name, colour in (("0_0", 1), ("0_1", 2), ("1_0", 3)):
        files_of_part = {"sh0.webp": sogfiles.webp([[colour, row, 0, 255] for row in range(3)])}
        out |= {f"{name}/{file}": data for file, data in sogfiles.files(**files_of_part).items()}
    files_of_part = saved(random_splats(300, degree=2), "meta.json")
    out |= {f"0_2/{file}": data for file, data in files_of_part.items()}

    def span(file, offset, count):
        return {"file": file, "offset": offset, "count": count}

    manifest = {
        "lodLevels": 2,
        "environment": None,
        "filenames": [f"{name}/meta.json" for name in ("1_0", "0_0", "0_1", "0_2")],
        "tree": {
            "bound": {"min": [0, 0, 0], "max": [1, 1, 1]},
            "children": [
                {"lods": {"0": span(2, 1, 2), "1": span(0, 0, 2)}},
                {"lods": {"0": span(1, 0, 3)}},
                {"children": [{"lods": {"0": span(2, 0, 1)}}, {"lods": {"0": span(3, 0, 300)}}]},
            ],
        },
    }
    sky = manifest | {"environment": "env/meta.json"}
    files_of_part = {f"env/{name}": data for name, data in sogfiles.files().items()}
    return [
        {"lod-meta.json": json.dumps(manifest).encode()} | out,
        {"lod-meta.json": json.dumps(sky).encode()} | out | files_of_part,
    ]


def _archived():
    """Pack each of the same streams in one zip."""
    found = []
    for files in _streamed():
        out = bytes_io.BytesIO()
        sogfiles.bundle(out, files)
        found.append({"a.ssog": out.getvalue()})
    return found


def _usual(name):
    return lambda: [saved(model, name) for model in models((0, 1, 3))]


def _packed_glbs():
    out = []
    for model in models((0, 1, 3)):
        file = bytes_io.BytesIO()
        gltf_spz.write(model, file)
        out.append({"a.glb": file.getvalue()})
    return out


def _gltfs():
    """Convert `.glb` files to text, with their buffer in a `data:` URI or in a file beside it."""
    out = []
    for number, files in enumerate(_usual("a.glb")()):
        data = files["a.glb"]
        (length,) = struct.unpack_from("<I", data, 12)
        content, body = json.loads(data[20 : 20 + length]), data[28 + length :]
        uri = f"data:a/b;base64,{base64.b64encode(body).decode()}" if number % 2 else "a.bin"
        content["buffers"][0]["uri"] = uri
        beside = {} if number % 2 else {"a.bin": body}
        out.append({"a.gltf": json.dumps(content).encode()} | beside)
    return out


def _tilesets():
    """Make tilesets of two levels: one tile is a nested tileset, one is rotated, one is text."""
    contents = {f"{n}.glb": saved(random_splats(n, degree=1), "a.glb")["a.glb"] for n in (3, 40)}
    contents["7.glb"] = _packed_glbs()[2]["a.glb"]
    contents |= {"b/" + name: data for name, data in _gltfs()[0].items()}
    box = {"boundingVolume": {"box": [0] * 12}, "geometricError": 1}
    quarter = [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1]
    leaves = [
        box | {"content": {"uri": "7.glb"}, "transform": quarter},
        box | {"content": {"uri": "b/tileset.json"}},
    ]
    root = box | {"content": {"uri": "3.glb"}, "refine": "REPLACE", "children": leaves}
    inner = box | {"contents": [{"uri": "a.gltf"}], "refine": "ADD"}
    outer = {"asset": {"version": "1.1"}, "root": root}
    files = {"tileset.json": outer, "b/tileset.json": {"root": inner}}
    texts = {name: json.dumps(content).encode() for name, content in files.items()}
    beside = {"content": {"uri": "40.glb"}, "transform": quarter, "children": [root]} | box
    deeper = texts | {"tileset.json": json.dumps({"root": beside}).encode()}
    return [texts | contents, deeper | contents]


def _rads():
    """Make `.rad` files as nanogs writes them, with a tree, and with a palette."""
    tree = radfiles.rad(radfiles.small_tree()[0], 8, lodTree=True)
    others = [tree, radfiles.with_palette()[0], radfiles.with_palette(300, 200)[0]]
    return _usual("a.rad")() + [{"a.rad": data} for data in others]


def _chunked_rads():
    """Make a `.rad` file with each chunk in a file of its own."""
    names = ["a-0.radc", "a-1.radc"]
    places = [{"offset": 0, "bytes": 1, "filename": name} for name in names]
    head = radfiles.rad([], 8, chunks=places, lodTree=True)
    return [{"a.rad": head} | dict(zip(names, radfiles.small_tree()[0], strict=True))]


def _lccs():
    """Make models with and without harmonics and sky; the description comes first."""
    rng = np.random.default_rng(11)
    return [
        lccfiles.typical_model(rng, quality=quality, environment=environment)
        for quality, environment in ((False, 0), (True, 4), (False, 3))
    ]


def _lcc2s():
    """Make models of both formats of files, with older and newer names of fields."""
    found = []
    for kind, old, sky in ((".sog", False, 4), (".spz", False, 0), (".sog", True, 3)):
        with tempfile.TemporaryDirectory() as folder:
            rng = np.random.default_rng(11)
            path, _ = lcc2files.model(Path(folder), rng, kind, old=old, environment=sky)
            found.append(files_of(path))
    return found


def index_of_lcc(rng, files):
    """Damage a byte of the cells' counts, offsets or sizes."""
    damaged = bytearray(files["index.bin"])
    offset = int(rng.integers(len(damaged)))
    damaged[offset] = rng.choice([0, 1, 2, 32, 127, 128, 255])
    return files | {"index.bin": bytes(damaged)}


FORMATS = {
    ".ply": (_plys, [damage_first_file, damage_first_file, damage_any_file]),
    ".compressed.ply": (_usual("a.compressed.ply"), [damage_first_file, damage_any_file]),
    ".csv": (_usual("a.csv"), [damage_first_file, damage_any_file]),
    ".splat": (_usual("a.splat"), [damage_any_file]),
    ".npz": (_usual("a.npz"), [damage_any_file, inside_zip, inside_zip]),
    ".spz v1": (lambda: _spzs(1), [damage_any_file, inside_gzip, inside_gzip]),
    ".spz v2": (lambda: _spzs(2), [damage_any_file, inside_gzip, inside_gzip]),
    ".spz v3": (lambda: _spzs(3), [damage_any_file, inside_gzip, inside_gzip]),
    ".spz, no gzip": (lambda: list(map(inflated, _spzs(2) + _spzs(3))), [damage_any_file]),
    ".spz v4": (lambda: _spzs(4), [damage_any_file, inside_zstd]),
    ".ksplat": (_ksplats, [damage_any_file]),
    ".glb": (_usual("a.glb"), [damage_any_file, inside_glb, inside_glb]),
    ".glb, packed": (_packed_glbs, [damage_any_file, inside_glb, inside_packed_glb]),
    ".gltf": (_gltfs, [damage_any_file, inside_gltf, inside_gltf, one_missing]),
    ".usda": (_usual("a.usda"), [damage_first_file, damage_first_file, damage_any_file]),
    ".rad": (_rads, [damage_any_file, inside_rad, inside_rad, inside_rad]),
    ".rad and .radc": (_chunked_rads, [damage_any_file, one_missing]),
    ".lcc": (_lccs, [damage_any_file, whole_json, index_of_lcc, one_missing]),
    ".lcc2": (_lcc2s, [damage_any_file, damage_first_file, whole_json, whole_json, one_missing]),
    ".sog": (_bundles, [damage_any_file, inside_zip, inside_zip]),
    "SOG v1, folder": (_sogs_1, [damage_any_file, whole_json, one_texture, one_missing]),
    "SOG v2, folder": (
        lambda: [saved(model, "meta.json") for model in models((0, 3))],
        [damage_any_file, whole_json, one_texture, one_missing],
    ),
    "lod-meta.json": (
        _streamed,
        [damage_any_file, whole_json, whole_json, one_description, one_missing],
    ),
    ".ssog": (_archived, [damage_any_file, inside_zip, inside_zip]),
    "tileset.json": (
        _tilesets,
        [damage_any_file, whole_json, whole_json, one_description, one_missing],
    ),
    ".pt": (lambda: _checkpoints(".pt", torchfiles.gsplat), [damage_any_file, inside_stored_zip]),
    ".ckpt": (
        lambda: _checkpoints(".ckpt", torchfiles.nerfstudio),
        [damage_any_file, inside_stored_zip],
    ),
    ".pth": (
        lambda: _checkpoints(".pth", torchfiles.reference_trainer),
        [damage_any_file, inside_stored_zip],
    ),
    ".pt, old": (lambda: _checkpoints(".pt", torchfiles.gsplat, legacy=True), [damage_any_file]),
}


@functools.cache
def format_named(name):
    """Make the seeds of a format of `FORMATS`."""
    seeds, mutations = FORMATS[name]
    return Format(seeds(), mutations)
