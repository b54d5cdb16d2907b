"""`Splats`, the in-memory model of a 3D Gaussian splatting scene.

`Splats` holds *stored* values, those of a 3DGS `.ply` (log-scale, logit opacity, quaternion of any
length), so that reading and writing change no bit. Its methods return *activated* values (scale,
alpha, unit quaternion).
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from nanogs import parallel
from nanogs._arrays import as_array, as_floats, as_rows, each_row
from nanogs._types import F32, F64, I32, I64, Array, Bool, F
from nanogs.activations import alphas, unit
from nanogs.errors import ModelError, OptionError
from nanogs.ranges import is_number
from nanogs.slices import SLICE, SLICE_STEPS, slices

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

MAX_SH_DEGREE = 4
COLUMNS = ("means", "log_scales", "quats", "opacity_logits", "sh")


class RenderMode(StrEnum):
    """The rasteriser that a model was trained for; it must be rendered the same way."""

    DEFAULT = "default"
    MIP = "mip"  # antialiased: opacity compensated for the screen-space dilation
    SURFEL = "2dgs"  # flat splats, intersected with rays


@dataclass(frozen=True, slots=True, eq=False)
class ExtraElement:
    """A PLY element other than `vertex`, whose rows are not splats; carried through unread.

    Attributes:
        name: The element's name in the header.
        rows: (R,) structured array, native byte order, one field for each property.
    """

    name: str
    rows: Array

    def is_per_splat(self, count: int) -> bool:
        """Return whether it has one row for each of `count` splats; False for a single splat."""
        return len(self.rows) == count > 1

    def of_rows(self, rows: I64 | I32 | Bool | slice, count: int) -> "ExtraElement":
        """Return the element for some of `count` splats; unchanged if its rows are not theirs."""
        kept = pick(self.rows, rows) if self.is_per_splat(count) else self.rows
        return ExtraElement(self.name, kept)


_LISTS = {"comments": str, "elements": ExtraElement, "notes": str}  # fields, and their entries


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False, repr=False)
class Splats:
    """N splats, one array for each stored quantity.

    Every argument that NumPy can convert to an array is accepted: lists, tensors, other number
    types. Columns become float32; only `means` keeps float64, and `extras` keep their dtypes. What
    needs no conversion is not copied: such an array or tensor and the model share memory.
    `splats[rows]` selects splats by a number, a slice, a mask or an array of row numbers. Notebooks
    show a small picture.

    Attributes:
        means: (N, 3) float32, or float64 if the file holds doubles; scene units.
        log_scales: (N, 3) float32, natural logarithm of the standard deviations in scene units.
        quats: (N, 4) float32, wxyz, of any length as stored.
        opacity_logits: (N,) float32; ±inf means alpha 1 or 0 and is valid data.
        sh: (N, (degree + 1)², 3) float32, spherical-harmonic coefficients, RGB last; `sh[:, 0]` is
            the base colour's (`f_dc`).
        extras: Further columns by name, each (N,) of any dtype; never interpreted, never averaged.
        render_mode: The rasteriser the model was trained for, as a `RenderMode` or its value, such
            as "mip".
        comments: Comment lines of the file, without the keyword.
        elements: Further PLY elements, carried through.
        notes: Changes and losses of reading, one sentence each, for the user.

    Raises:
        ModelError: The arrays' shapes disagree, a value is no array of real numbers or has masked
            entries, or another argument is of another type.
    """

    means: F
    log_scales: F32
    quats: F32
    opacity_logits: F32
    sh: F32
    extras: Mapping[str, Array] = field(default_factory=dict)
    render_mode: RenderMode = RenderMode.DEFAULT
    comments: Sequence[str] = ()
    elements: Sequence[ExtraElement] = ()
    notes: Sequence[str] = ()

    if TYPE_CHECKING:  # the constructor accepts more types than the fields have

        def __init__(
            self,
            means: ArrayLike,
            log_scales: ArrayLike,
            quats: ArrayLike,
            opacity_logits: ArrayLike,
            sh: ArrayLike,
            extras: Mapping[str, ArrayLike] = ...,
            render_mode: RenderMode | str = ...,
            comments: Iterable[str] = ...,
            elements: Iterable[ExtraElement] = ...,
            notes: Iterable[str] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        """Convert the arguments to arrays, freeze the containers, and check the shapes."""
        for name in COLUMNS:
            array = as_floats(name, getattr(self, name), double=name == "means")
            if name == "opacity_logits" and array.shape[1:] == (1,):
                array = array[:, 0]  # the shape that trainers use
            object.__setattr__(self, name, array)
        self._freeze()
        self._check()

    def _freeze(self) -> None:
        try:
            columns = dict(self.extras)
        except (TypeError, ValueError):
            kind = type(self.extras).__name__
            raise ModelError(
                f"extras must be a dictionary of columns by name, not {kind}."
            ) from None
        if unnamed := [name for name in columns if not isinstance(name, str)]:
            raise ModelError(f"The name of an extra column must be text, not {unnamed[0]!r}.")
        extras = {name: as_array(f"extra column {name!r}", a) for name, a in columns.items()}
        object.__setattr__(self, "extras", MappingProxyType(extras))
        for name, entry in _LISTS.items():
            object.__setattr__(self, name, _as_tuple(name, entry, getattr(self, name)))
        if self.render_mode not in tuple(RenderMode):
            modes = ", ".join(RenderMode)
            raise ModelError(f"render_mode must be one of {modes}, not {self.render_mode!r}.")
        object.__setattr__(self, "render_mode", RenderMode(self.render_mode))

    def _check(self) -> None:
        n = len(self.means) if self.means.ndim else 0
        if self.means.shape != (n, 3):
            raise ModelError(f"means must be (N, 3), not {self.means.shape}.")
        for name, shape in row_shapes(self.sh_degree).items():
            given = getattr(self, name).shape
            if given != (n, *shape):
                raise ModelError(f"{name} must be {(n, *shape)} like means, not {given}.")
        for name, column in self.extras.items():
            if column.shape != (n,):
                raise ModelError(f"extra column {name!r} must be ({n},), not {column.shape}.")

    def __reduce__(self) -> tuple[Callable[[dict[str, Any]], "Splats"], tuple[dict[str, Any]]]:
        # Not by `__getstate__`, which dataclasses of Python 3.11.2 and before replace.
        state = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return _restored, (state | {"extras": dict(self.extras)},)  # a proxy cannot be pickled

    def __repr__(self) -> str:
        from nanogs.summary import one_line

        return f"Splats({one_line(self)})"

    def _repr_html_(self) -> str:
        from nanogs.summary import html

        return html(self)

    def _repr_png_(self) -> bytes | None:
        from nanogs.summary import picture

        found = picture(self)
        return found if isinstance(found, bytes) else None

    @classmethod
    def from_gsplat(
        cls, tensors: Mapping[str, object], *, render_mode: RenderMode | str = RenderMode.DEFAULT
    ) -> "Splats":
        """Make a model from gsplat's dictionary of parameters: arrays, or tensors on any device.

        Args:
            tensors: `means` (N, 3), `scales` (N, 3) logarithms, `quats` (N, 4) wxyz, `opacities`
                (N,) logits, `sh0` (N, 1, 3) and `shN` (N, K, 3); or in place of the last two
                `colors`: (N, 1 + K, 3) for both, or (N, 3) for RGB from 0 to 1. Other names are
                ignored, with a note.
            render_mode: "mip" if the model was trained antialiased, "2dgs" if with 2DGS.

        Raises:
            ModelError: A name is missing, a shape is wrong, or the colours come from a network.
        """
        from nanogs.gsplat_arrays import from_gsplat

        return from_gsplat(tensors, render_mode)

    def to_gsplat(self) -> dict[str, F32]:
        """Return copies of the columns under gsplat's names, for `torch.from_numpy`.

        Returns:
            `means` (N, 3), `scales` (N, 3) logarithms, `quats` (N, 4) wxyz of any length,
            `opacities` (N,) logits, `sh0` (N, 1, 3) and `shN` (N, K, 3); all float32: float64
            centres are rounded.
        """
        from nanogs.gsplat_arrays import to_gsplat

        return to_gsplat(self)

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: Any) -> "Splats":  # noqa: ANN401 - many ways to name rows
        chosen = as_rows(rows, len(self))
        elements = [each.of_rows(chosen, len(self)) for each in self.elements]
        return replace(self.take(chosen), elements=elements)

    def __iter__(self) -> "Iterator[Splats]":
        return (self[row] for row in range(len(self)))

    def __array__(self, *_arguments: object, **_options: object) -> Array:
        raise TypeError(
            "A model is not a single array; use one of its arrays, such as splats.means."
        )

    @property
    def sh_degree(self) -> int:
        """Spherical-harmonic degree, 0 to 4, from the number of coefficients.

        Raises:
            ModelError: The number of coefficients is not that of a degree from 0 to 4.
        """
        count = self.sh.shape[1] if self.sh.ndim == 3 else -1
        for degree in range(MAX_SH_DEGREE + 1):
            if count == (degree + 1) ** 2:
                return degree
        raise ModelError(f"sh must be (N, 1|4|9|16|25, 3), not {self.sh.shape}.")

    def scales(self) -> F32:
        """Return (N, 3) float32 standard deviations along the splats' own axes, scene units."""
        with np.errstate(over="ignore", invalid="ignore"):  # signalling NaNs would warn
            return np.exp(self.log_scales)

    def opacities(self) -> F64:
        """Return (N,) float64 alpha in [0, 1].

        Double precision keeps 1 - alpha accurate for opaque splats.
        """
        return alphas(self.opacity_logits)

    def unit_quats(self) -> F32:
        """Return (N, 4) float32 unit quaternions, wxyz; a zero one becomes the identity."""
        return unit(self.quats)

    def finite(self) -> Bool:
        """Return an (N,) bool mask of the splats without NaN or infinite values.

        An infinite opacity logit is allowed. A log-scale of -inf is a scale of zero and counts as
        finite; a scale or a centre beyond the range of float32 does not.
        """
        found = np.empty(len(self), bool)

        def look(rows: slice) -> None:
            found[rows] = _finite(self.span(rows.start, rows.stop))

        parallel.for_each(slices(len(self), SLICE_STEPS), look)
        return found

    def take(self, rows: Any) -> "Splats":  # noqa: ANN401 - many ways to name rows
        """Return some splats, selected as in `splats[rows]`, with all columns and metadata.

        Further PLY elements stay whole.

        Raises:
            IndexError: The model has no such rows.
        """
        rows = as_rows(rows, len(self))
        columns: dict[str, Any] = {name: pick(getattr(self, name), rows) for name in COLUMNS}
        extras = {name: pick(column, rows) for name, column in self.extras.items()}
        return replace(self, **columns, extras=extras)

    def span(self, start: int, stop: int) -> "Splats":
        """Return rows `start` to `stop`, exclusive, as views of these arrays."""
        return self.take(slice(start, stop))

    def with_sh_degree(self, degree: int) -> "Splats":
        """Return the model without the bands of spherical harmonics above a degree.

        Args:
            degree: The highest degree to keep, 0 to 4; a model of a lower one is returned
                unchanged.

        Raises:
            OptionError: The degree is not from 0 to 4.
        """
        check_degree(degree)
        if degree >= self.sh_degree:
            return self
        return replace(self, sh=np.ascontiguousarray(self.sh[:, : (degree + 1) ** 2]))


def _as_tuple(name: str, kind: type, given: object) -> tuple[Any, ...]:
    """Convert the value of a field that is a list to a tuple.

    Args:
        name: Name of the field, for the message.
        kind: Type of its entries.
        given: The value.

    Raises:
        ModelError: It is no list, or an entry is of another type.
    """
    if isinstance(given, str):  # tuple() would split it into letters
        raise ModelError(f"{name} must be a list, not one text; put the text into a list.")
    entries = "text" if kind is str else kind.__name__
    if not isinstance(given, Iterable):
        raise ModelError(f"{name} must be a list of {entries}, not {given!r}.")
    found = tuple(given)
    for entry in found:
        if not isinstance(entry, kind):
            raise ModelError(f"{name} must be a list of {entries}, not of {type(entry).__name__}.")
    return found


def _restored(state: Mapping[str, Any]) -> Splats:
    """Return the model whose fields were pickled or copied."""
    splats = object.__new__(Splats)
    for name, value in state.items():
        object.__setattr__(splats, name, value)
    splats._freeze()
    return splats


def check_degree(sh_degree: int | None) -> None:
    """Refuse a degree of spherical harmonics that models cannot have.

    Raises:
        OptionError: The degree is neither None nor from 0 to 4.
    """
    if sh_degree is None:
        return
    if not is_number(sh_degree, whole=True):
        raise OptionError(f"The SH degree must be a whole number, not {sh_degree!r}.")
    if not 0 <= sh_degree <= MAX_SH_DEGREE:
        raise OptionError(
            f"The SH degree must be from 0 to {MAX_SH_DEGREE}, not {sh_degree}; give such a"
            " `sh_degree`."
        )


def _finite(splats: Splats) -> Bool:
    """Return the mask of finite splats; see `Splats.finite`."""
    ok = ~np.isnan(splats.opacity_logits)
    most = np.finfo(np.float32).max
    for column in (splats.means, splats.scales(), splats.quats, splats.sh):
        flags = np.isfinite(column) if column.dtype == np.float32 else np.abs(column) <= most
        ok &= each_row(flags)
    return ok


def pick(column: Array, rows: I64 | I32 | Bool | slice) -> Array:
    """Return some rows of an array, given by indices, a mask or a slice.

    Many rows are copied on all threads, because the copy is bound by memory.
    """
    if isinstance(rows, slice) or rows.dtype == bool:
        return column[rows]
    if len(rows) <= SLICE:
        return column.take(rows, axis=0)  # takes a fifth of the time of fancy indexing
    found = np.empty((len(rows), *column.shape[1:]), column.dtype)

    def take(part: slice) -> None:
        found[part] = column.take(rows[part], axis=0)

    parallel.for_each(slices(len(rows)), take)
    return found


def refuse_other(model: object) -> None:
    """Refuse an argument that is not a `Splats`, such as a path.

    Raises:
        ModelError: It is not a model.
    """
    if isinstance(model, str | os.PathLike):
        path = os.fspath(model)
        raise ModelError(
            f"A model is needed, not the path {path!r}; nanogs.load({path!r}) reads it."
        )
    if not isinstance(model, Splats):
        raise ModelError(
            f"A model is needed, Splats, not {type(model).__name__}; {how_to_make(model)}."
        )


def how_to_make(given: object) -> str:
    """Return how to get a model in place of something else, as the end of a message."""
    if isinstance(given, tuple) and given and isinstance(given[0], Splats):
        return "take the first of the tuple, as in `small, report = nanogs.simplify(...)`"
    return (
        "nanogs.Splats makes a model of arrays, and nanogs.Splats.from_gsplat of a dictionary of"
        " tensors"
    )


def refuse_misaligned(elements: Iterable[tuple[str, int]], count: int, target: int) -> None:
    """Refuse to remove splats from a model with a PLY element that has one row for each splat.

    Args:
        elements: Name and number of rows of each element.
        count: Number of splats of the model.
        target: Number of splats to keep.

    Raises:
        ModelError: There is such an element, and splats would be removed.
    """
    for name, rows in elements:
        if rows == count > max(target, 1):
            raise ModelError(
                f"The element {name!r} has one row for each splat and would not fit the "
                "smaller model; remove it from the file first."
            )


def refuse_misaligned_elements(splats: Splats, target: int) -> None:
    """Apply `refuse_misaligned` to a model in memory."""
    elements = ((element.name, len(element.rows)) for element in splats.elements)
    refuse_misaligned(elements, len(splats), target)


def concatenate(parts: Sequence[Splats]) -> Splats:
    """Concatenate models that have the same columns.

    Metadata is that of the first; missing spherical-harmonic coefficients become zeros.

    Args:
        parts: One or more models.

    Raises:
        ModelError: There is none, or their extra columns differ.
    """
    if not parts:
        raise ModelError("At least one model is needed.")
    first = parts[0]
    for part in parts:
        refuse_other(part)
        if differing := sorted(part.extras.keys() ^ first.extras.keys()):
            raise ModelError(
                f"Models whose extra columns differ ({', '.join(differing)}) cannot be"
                " concatenated; leave these out with dataclasses.replace(model, extras={})."
            )
    most = max(part.sh.shape[1] for part in parts)
    return replace(
        first,
        means=np.concatenate([part.means for part in parts]),
        log_scales=np.concatenate([part.log_scales for part in parts]),
        quats=np.concatenate([part.quats for part in parts]),
        opacity_logits=np.concatenate([part.opacity_logits for part in parts]),
        sh=np.concatenate([padded(part.sh, most) for part in parts]),
        extras={
            name: np.concatenate([part.extras[name] for part in parts]) for name in first.extras
        },
    )


def row_shapes(degree: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of a splat's entry in each array of `Splats`, by name, for an SH degree."""
    return dict(zip(COLUMNS, ((3,), (3,), (4,), (), ((degree + 1) ** 2, 3)), strict=True))


def empty_arrays(count: int, degree: int) -> dict[str, Any]:
    """Allocate the arrays of `Splats` by name, uninitialised, of `count` rows and an SH degree."""
    shapes = row_shapes(degree).items()
    return {name: np.empty((count, *shape), np.float32) for name, shape in shapes}


def padded(sh: F32, coefficients: int) -> F32:
    """Pad (N, K, 3) coefficients with zeros to at least `coefficients` for each splat."""
    if sh.shape[1] >= coefficients:
        return sh
    longer = np.zeros((len(sh), coefficients, 3), np.float32)
    longer[:, : sh.shape[1]] = sh
    return longer
