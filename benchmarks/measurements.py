"""The measurements of `quality.py`: cached as JSON lines, and made if they are missing."""

import hashlib
import json
import os
import pickle
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nanogs.bench.baselines import BASELINES
from nanogs.bench.digest import digest_of_sources
from nanogs.bench.worker import Job, run_job
from nanogs.io import inspect, load
from nanogs.pipeline.options.target import target_count
from nanogs.protocol import BLACK, Background
from nanogs.raster.camera import Camera
from nanogs.raster.rendering import prepare
from nanogs.scoring.photos import photographs
from nanogs.scoring.scores import ReferenceView, reference_views, score
from nanogs.scoring.view_sets import view_sets
from nanogs.splats import Splats
from nanogs.views.automatic import automatic_cameras
from rivals import RIVALS, rival_version, run_tool
from unbounded import SCENES as UNBOUNDED
from unbounded import make

KINDS = ("512", "1600", "roam", "photographs")
SCENES = {
    "biker": "biker.compressed.ply",
    "skull": "skull.sog",
    "plant": "plant.splat",
    "seal": "seal.splat",
    "chair": "chair.splat",
    "flowers": "flowers/lod-meta.json",
    "guitar": "guitar.compressed.ply",
    "kitchen": "kitchen.spz",
    "playbot": "playbot/lod-meta.json",
}
UP = {"chair": (0.0, 0.0, 1.0)}  # up directions that cannot be found from the model
PHOTOS = {"chair": "chair_photos"}
PEERS = ("nanogs-ref",)  # methods whose results were made beforehand, for some scenes
SIZE = 512  # pixels of kinds of views without a size
BASELINE_VIEWS = 40  # number of views that baselines learn from
# Packages that do not affect results of presets, of baselines, and scores of a result.
APART = ("cli", "bench", "scoring", "view", "lod", "studio")
BASELINES_APART = tuple(name for name in APART if name != "bench")
SCORES_APART = ("cli", "bench", "view", "lod", "studio", "method", "pipeline", "fit", "store")
Row = dict[str, Any]
Tell = Callable[[str], None]


class Key(NamedTuple):
    """The key of a measurement."""

    scene: str
    ratio: float
    method: str
    kind: str


@dataclass(frozen=True)
class Views:
    """The reference views of one kind that a scene's results are compared with."""

    views: list[ReferenceView]
    background: Background


class Bench:
    """A cache folder of scenes, results and measurements."""

    def __init__(self, scenes: Path, peers: Path, folder: Path) -> None:
        self.scenes, self.peers, self.folder = scenes, peers, folder
        self.rows_file = folder / "measured.jsonl"
        self.digests = {apart: digest_of_sources(apart) for apart in (APART, BASELINES_APART)}
        self.scorer = digest_of_sources(SCORES_APART)

    def offers(self, key: Key) -> bool:
        """Return whether a scene has views of a kind, and the method's result if it is to exist."""
        return not self.lacks(key) and (key.kind != "photographs" or key.scene in PHOTOS)

    def lacks(self, key: Key) -> bool:
        """Return whether a result should have been made beforehand, and was not."""
        return key.method in PEERS and not self.peer(key).exists()

    def measure(self, keys: Sequence[Key], tell: Tell) -> list[Row]:
        """Return the rows of the keys; missing ones are measured and cached, scene by scene."""
        by_scene = defaultdict(list)
        for key in keys:
            by_scene[key.scene].append(key)
        return [row for name, some in by_scene.items() for row in self._of_scene(name, some, tell)]

    def _of_scene(self, scene: str, keys: Sequence[Key], tell: Tell) -> list[Row]:
        model = self.model(scene)
        cameras = {
            kind: self.cameras(scene, kind) for kind in dict.fromkeys(key.kind for key in keys)
        }
        known = self._known()
        digests = {kind: self._digest(scene, kind, some) for kind, some in cameras.items()}
        names = {key: self._name(key, digests[key.kind]) for key in keys}
        missing = [key for key in keys if names[key] not in known]
        if missing:
            splats = load(model)
            kinds = dict.fromkeys(key.kind for key in missing)
            views = {kind: self._views(scene, splats, kind, cameras[kind]) for kind in kinds}
            for key in missing:
                known[names[key]] = self._measured(key, views[key.kind], names[key])
                tell(text_of(known[names[key]]))
        return [known[names[key]] for key in keys]

    def _known(self) -> dict[str, Row]:
        """Read the cached rows by name; of several with one name, the last counts."""
        if not self.rows_file.exists():
            return {}
        rows = map(json.loads, self.rows_file.read_text().splitlines())
        return {row["name"]: row for row in rows}

    def _name(self, key: Key, views: str) -> str:
        """Return the cache key of a row: a text of everything that it depends on.

        Args:
            key: The key of the measurement.
            views: From `_digest`.
        """
        return " | ".join([*map(str, key), self.version(key.method), views, self.scorer])

    def _digest(self, scene: str, kind: str, cameras: Sequence[Camera]) -> str:
        """Return a hash of the views of a kind: of the cameras, or of the photographs' folder."""
        if kind == "photographs":
            return digest_of_folder(self.scenes / PHOTOS[scene])
        return digest_of_cameras(cameras)

    def version(self, method: str) -> str:
        """Return the version of the program that a method belongs to."""
        if method in RIVALS:
            return rival_version()
        if self._kept(method):
            return "kept"
        return f"nanogs {self.digests[apart_of(method)]}"

    def _kept(self, method: str) -> bool:
        return any(self.peers.glob(f"*_{method}.ply"))

    def peer(self, key: Key) -> Path:
        """Return the path of a result that was made beforehand."""
        return self.peers / f"{key.scene}_{key.ratio:g}_{key.method}.ply"

    def _measured(self, key: Key, views: Views, name: str) -> Row:
        """Make the result if it is missing, score it, and append the row to the cache."""
        path, figures = self._result(key)
        small = load(path)
        found = score(key.method, prepare(small), views.views, views.background)
        row = {
            **key._asdict(), "splats": len(small), "views": len(views.views), "psnr": found.psnr,
            "least_psnr": found.least_psnr, "ssim": found.ssim, **figures, "name": name,
        }  # fmt: skip
        with self.rows_file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        return row

    def _result(self, key: Key) -> tuple[Path, Row]:
        """Return a method's model, made if it is missing, with its seconds and peak memory."""
        if self._kept(key.method) and key.method not in RIVALS:
            return self.peer(key), {}
        target = result_file(
            self.folder, key.scene, key.ratio, key.method, self.version(key.method)
        )
        note = target.with_suffix(".json")
        if not (target.exists() and note.exists()):
            target.parent.mkdir(parents=True, exist_ok=True)
            fresh = target.with_name(f"{os.getpid()}_{target.name}")
            made = self._decimate if key.method in RIVALS else self._simplify
            figures = made(key, fresh)
            fresh.replace(target)
            note.write_text(json.dumps(figures))
        return target, json.loads(note.read_text())

    def _decimate(self, key: Key, target: Path) -> Row:
        """Simplify with splat-transform; seconds include its reading and writing of files."""
        model = self.model(key.scene)
        count = target_count(inspect(model).splats, key.ratio, None)
        seconds, peak = run_tool(model, RIVALS[key.method], str(count), target)
        return {"seconds": seconds, "peak_memory": peak}

    def _simplify(self, key: Key, target: Path) -> Row:
        """Simplify with one of our methods in a separate process."""
        model = self.model(key.scene)
        learnt: tuple[Camera, ...] = ()
        if key.method in BASELINES:  # presets find views of their own
            learnt = tuple(automatic_cameras(load(model), BASELINE_VIEWS))
        outcome = run_job(Job(model, key.method, key.ratio, target, learnt))
        if outcome.error:
            raise SystemExit(f"{key}: {outcome.error}")
        apart = apart_of(key.method)
        if digest_of_sources(apart) != self.digests[apart]:
            target.unlink()
            raise SystemExit(
                "The sources were changed meanwhile; start again: what is done is kept."
            )
        return {"seconds": outcome.seconds, "peak_memory": outcome.peak_memory}

    def model(self, scene: str) -> Path:
        """Return a scene as .ply, made if it is missing: converted (level 0), or by `unbounded`."""
        target = self.folder / "scenes" / f"{scene}.ply"
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            fresh = target.with_name(f"{os.getpid()}_{target.name}")
            if scene in UNBOUNDED:
                make(scene, self.model, fresh)
            else:
                source = self.scenes / SCENES[scene]
                level = ["-L", "0"] if source.name == "lod-meta.json" else []
                run_tool(*level, source, fresh)
            fresh.replace(target)
        return target

    def cameras(self, scene: str, kind: str) -> list[Camera]:
        """Return test views of a kind, cached until sources change that affect them.

        For photographs the result is empty.
        """
        if kind == "photographs":
            return []
        rendering = digest_of_sources(
            (*APART, "method", "pipeline", "fit", "io", "kernels", "datasets")
        )
        kept = self.folder / "views" / f"{scene}_{kind}_{rendering}.pickle"
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            source, size = parse_kind(kind)
            splats, up = load(self.model(scene)), UP.get(scene)
            [found] = view_sets(splats, [source], [(size, size)], up=up)
            kept.write_bytes(pickle.dumps(list(found.cameras)))
        cameras: list[Camera] = pickle.loads(kept.read_bytes())
        return cameras

    def _views(self, scene: str, splats: Splats, kind: str, cameras: Sequence[Camera]) -> Views:
        if kind == "photographs":
            photos = photographs(self.scenes / PHOTOS[scene], None, "test", None)
            return Views(list(photos), photos.background)
        found, _ = reference_views(prepare(splats), cameras, BLACK, depth=False)
        return Views(found, BLACK)


def apart_of(method: str) -> tuple[str, ...]:
    """Return the packages that do not affect the results of one of our methods."""
    return BASELINES_APART if method in BASELINES else APART


def result_file(folder: Path, scene: str, ratio: float, method: str, version: str) -> Path:
    """Return the path of a method's model."""
    name = f"{scene}_{ratio:g}_{method}_{version}".replace(" ", "_").replace(":", "_")
    return folder / "results" / f"{name}.ply"


def parse_kind(kind: str) -> tuple[str, int]:
    """Split a kind like "512", "roam" or "roam@1600" into the kind of cameras and the pixels."""
    source, _, size = kind.partition("@")
    return ("auto", int(source)) if source.isdigit() else (source, int(size or SIZE))


def text_of(row: Row) -> str:
    """Format a row in one line."""
    return (
        f"{row['scene']} {row['ratio']:g} {row['method']} {row['kind']}: {row['psnr']:.2f} dB,"
        f" worst {row['least_psnr']:.2f}, SSIM {row['ssim']:.4f}, {row.get('seconds', 0):.1f} s"
    )


def made_before(path: Path) -> Path:
    """Return the path of a file that `quality.py` makes; end the program if it is absent."""
    if not path.exists():
        sys.exit(f"{path} is missing: run benchmarks/quality.py with this scene and ratio first.")
    return path


def digest_of_cameras(cameras: Iterable[Camera]) -> str:
    """Return a short hash of the cameras' poses, focal lengths and sizes."""
    found = hashlib.sha1(usedforsecurity=False)
    for camera in cameras:
        numbers = [*camera.world_to_camera.ravel(), camera.fx, camera.width, camera.near]
        found.update(np.round(numbers, 6).astype(np.float64).tobytes())
    return found.hexdigest()[:10]


def digest_of_folder(folder: Path) -> str:
    """Return a short hash of the names and contents of all files in a folder."""
    found = hashlib.sha1(usedforsecurity=False)
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        found.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return found.hexdigest()[:10]
