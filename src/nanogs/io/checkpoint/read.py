"""Reading training checkpoints: gsplat's `.pt`, nerfstudio's `.ckpt`, Inria's `chkpnt*.pth`.

gsplat (examples/simple_trainer.py) saves `splats`: means, scales (logarithms), quats (wxyz),
opacities (logits), sh0 and shN. nerfstudio (models/splatfacto.py) has features_dc and features_rest
in place of sh0 and shN, below `pipeline` as `_model.gauss_params.<name>`, in older versions
`_model.<name>`; trained without harmonics, its features_dc are logits of the colours. The reference
trainer (scene/gaussian_model.py, capture) saves a tuple: the active SH degree, xyz, features_dc,
features_rest, scaling, rotation, opacity and the state of the optimiser. Only the tensors of the
splats are read; the state of optimisers, most of a checkpoint, is not.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nanogs._types import F32, Array
from nanogs.activations import alphas, base_colour
from nanogs.errors import FormatError, ModelError
from nanogs.findings import Finding, Names, became_infinite
from nanogs.io import render_tag
from nanogs.io.checkpoint.torch_file import TorchFile
from nanogs.io.checkpoint.torch_pickle import Tensor
from nanogs.io.info import FileInfo
from nanogs.io.parts import Whole
from nanogs.io.texts import printable
from nanogs.splats import MAX_SH_DEGREE, RenderMode, Splats

FRAME = "that of the training, as stored; nerfstudio and gsplat turn scenes to have z up by default"
_SHAPED = ("scales", "quats", "opacities")
_COLOURS = (("sh0", "shN"), ("features_dc", "features_rest"))
_LEARNED = ("features", "colors")  # inputs of gsplat's appearance network, which computes colours
_MOST_CONTAINERS = 200
# Our names of the tensors that the tuple of `capture` holds after the degree, in order.
_CAPTURED = ("means", "sh0", "shN", "scales", "quats", "opacities")
_RANK = re.compile(r"(.*_rank)[0-9]+(\.[^.]+)")
_KINDS = {"f4": "float", "f8": "double", "f2": "float16", "bf": "bfloat16"}


class Checkpoint(Whole):
    """A training checkpoint; opening it reads the shapes of the tensors, but not their values.

    Raises:
        FormatError: It is damaged, its pickle refers to unexpected code, or it holds no splats of
            a known trainer.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = TorchFile(path)
        found, self._others = _find(path, self._file.content)
        self._found = found
        for tensor in found.values():
            self._file.check(tensor)
        flat = found["scales"].shape[1:] == (2,)
        self.info = FileInfo(
            path=path,
            format="checkpoint",
            encoding=self._file.encoding,
            file_bytes=self._file.file_bytes,
            splats=found["means"].shape[0] if found["means"].shape else 0,
            sh_degree=_degree(path, found),
            double_means=found["means"].storage.kind == "f8",
            properties=tuple(
                (name, _KINDS.get(tensor.storage.kind, tensor.storage.kind))
                for name, tensor in found.items()
            ),
            render_mode=RenderMode.SURFEL if flat else RenderMode.DEFAULT,
            render_tag=render_tag.TWO_SCALES if flat else "",
        )

    def load(self) -> Splats:
        """Read the whole model."""
        notes: list[str] = [*_other_ranks(self.path)]
        if self._others:
            notes.append(f"Left out of the checkpoint: {', '.join(map(printable, self._others))}.")
        arrays = {
            n: _floats(self.path, n, self._file.array(t), notes) for n, t in self._found.items()
        }
        count = len(arrays["means"])
        if self.info.render_mode is RenderMode.SURFEL:
            arrays["scales"] = np.insert(arrays["scales"], 2, -np.inf, axis=1)
            notes.append(render_tag.THIRD_SCALE)
        try:
            return Splats(
                means=arrays["means"],
                log_scales=arrays["scales"].astype(np.float32, copy=False),
                quats=arrays["quats"].astype(np.float32, copy=False),
                opacity_logits=arrays["opacities"].astype(np.float32, copy=False).reshape(count),
                sh=_harmonics(arrays, count),
                render_mode=self.info.render_mode,
                notes=notes,
            )
        except (ModelError, ValueError) as error:
            raise FormatError(f"{self.path}: {error} Save the splats again.") from None


def _degree(path: Path, found: Mapping[str, Tensor]) -> int:
    """Compute the SH degree from the shapes of the tensors."""
    rest = [tensor for name, tensor in found.items() if name in ("shN", "features_rest")]
    coefficients = 1 + (rest[0].shape[1] if rest and len(rest[0].shape) == 3 else 0)
    degrees = {(degree + 1) ** 2: degree for degree in range(MAX_SH_DEGREE + 1)}
    if coefficients not in degrees:
        raise FormatError(
            f"{path}: {coefficients} coefficients of spherical harmonics fit no degree from 0 to"
            f" {MAX_SH_DEGREE}; save the splats again."
        )
    return degrees[coefficients]


def _find(path: Path, content: Any) -> tuple[dict[str, Tensor], list[str]]:  # noqa: ANN401 - whatever was saved
    """Find the tensors of the only model in a saved object, by the last part of their names.

    Returns:
        The tensors, and the names of others beside them with a value for each splat.
    """
    if captured := _captured(content):
        return captured, []
    tensors = dict(_flatten(content, "", set()))
    models = [(found, name) for name in tensors if (found := _model(tensors, name))]
    if len(models) == 1:
        found, name = models[0]
        return found, _others(tensors, name, found)
    if models:
        raise FormatError(f"{path} holds {len(models)} models; save one of them alone.")
    lasts = {name.rpartition(".")[2] for name in tensors}
    if "means" in lasts and lasts & set(_LEARNED):
        raise FormatError(
            f"{path}: its colours come from a network (appearance optimisation), which no file of"
            " splats can hold; train without it, or export the splats."
        )
    shown = ", ".join(printable(name) for name in sorted(tensors)[:6]) or "none"
    raise FormatError(
        f"{path} holds no splats as gsplat, nerfstudio or the reference trainer save them (its"
        f" tensors: {shown}); export the splats as .ply."
    )


def _captured(content: Any) -> dict[str, Tensor] | None:  # noqa: ANN401
    """Find the tensors in a tuple of `capture`, alone or with the iteration; None for others."""
    for given in (content, content[0] if isinstance(content, tuple) and content else None):
        if not isinstance(given, tuple) or len(given) <= len(_CAPTURED):
            continue
        degree, tensors = given[0], given[1 : 1 + len(_CAPTURED)]
        if type(degree) is int and all(isinstance(each, Tensor) for each in tensors):
            return dict(zip(_CAPTURED, tensors, strict=True))
    return None


def _flatten(value: Any, prefix: str, seen: set[int]) -> Iterator[tuple[str, Tensor]]:  # noqa: ANN401
    """Yield the tensors in nested dictionaries, tuples and lists, with dotted names.

    Each container is visited once, because containers may contain each other.
    """
    if isinstance(value, Tensor):
        yield prefix, value
    elif isinstance(value, dict) and id(value) not in seen and len(seen) < _MOST_CONTAINERS:
        seen.add(id(value))
        for key, entry in value.items():
            if isinstance(key, str):  # optimisers number their tensors, which are not needed
                yield from _flatten(entry, f"{prefix}.{key}" if prefix else key, seen)
    elif isinstance(value, tuple | list) and id(value) not in seen and len(seen) < _MOST_CONTAINERS:
        seen.add(id(value))
        for place, entry in enumerate(value):
            yield from _flatten(entry, f"{prefix}.{place}" if prefix else str(place), seen)


def _model(tensors: Mapping[str, Tensor], means: str) -> dict[str, Tensor] | None:
    prefix, _, last = means.rpartition(".")
    if last != "means":
        return None

    def near(name: str) -> Tensor | None:
        return tensors.get(f"{prefix}.{name}" if prefix else name)

    found: dict[str, Tensor] = {"means": tensors[means]}
    for first, rest in _COLOURS:
        colours = {name: tensor for name in (first, rest) if (tensor := near(name))}
        shaped = {name: tensor for name in _SHAPED if (tensor := near(name))}
        if first in colours and len(shaped) == len(_SHAPED):
            return found | shaped | colours
    return None


def _others(tensors: Mapping[str, Tensor], means: str, model: Mapping[str, Tensor]) -> list[str]:
    """Return the names of the tensors beside a model's that have a value for each splat too."""
    prefix, count = means.removesuffix("means"), tensors[means].shape[:1]
    beside = {
        name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)
    }
    return [
        name
        for name, tensor in beside.items()
        if "." not in name and name not in model and count and tensor.shape[:1] == count
    ]


def _floats(path: Path, name: str, array: Array, notes: list[str]) -> Array:
    """Convert a tensor to float32, but keep centres in float64; overflows are added to `notes`."""
    if array.dtype.kind != "f":
        raise FormatError(f"{path}: {name} is {array.dtype}, not floats; save the splats again.")
    if name == "means" and array.dtype == np.float64:
        return array
    with np.errstate(over="ignore", invalid="ignore"):
        single = array.astype(np.float32, copy=False)
    if lost := int((np.isinf(single) & np.isfinite(array)).sum()):
        notes.append(became_infinite(name, lost))
    return single


def _harmonics(arrays: Mapping[str, Array], count: int) -> F32:
    """Assemble the SH coefficients, (N, K, 3)."""
    if "sh0" in arrays:
        base, rest = arrays["sh0"], arrays.get("shN")
    else:
        base, rest = arrays["features_dc"], arrays.get("features_rest")
        if rest is None or rest.size == 0:
            base = base_colour(alphas(base))
    parts = [base.reshape(count, 1, 3)]
    if rest is not None and rest.size:
        parts.append(rest.reshape(count, -1, 3))
    return np.concatenate(parts, axis=1).astype(np.float32, copy=False)


def _other_ranks(path: Path) -> list[Finding]:
    """Return a note if training on several devices left more files, with other splats.

    If several of them are read as one model, the note is about those that are in none of them.
    """
    match = _RANK.fullmatch(path.name)
    if match is None:
        return []
    others = Names(
        file.name
        for file in sorted(path.parent.iterdir())
        if (other := _RANK.fullmatch(file.name))
        and other.groups() == match.groups()
        and file.name != path.name
    )
    if not others:
        return []
    text = "The splats of other devices are in other files: {:6}."
    return [Finding(text, others, Names.intersection)]
