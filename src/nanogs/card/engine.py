"""Rendering on a Warp device: the device, models in its memory, and views of them."""

from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from nanogs._types import F32, F64, U8, Array, Bool, F
from nanogs.card.blending import blend_tiles, write_bytes
from nanogs.card.gradients import (
    Sums,
    gather_slots,
    pull_kernel,
    share_kernel,
    square_pixels,
    tint,
    weigh_pixels,
)
from nanogs.card.lighting import CardSums
from nanogs.card.listing import count_tiles, find_starts, write_tiles
from nanogs.card.projecting import Intrinsics, add_unoccluded, project_splats
from nanogs.card.shading import EDGE, PIXELS, WARP, Shape, shape_entries
from nanogs.errors import ModelError
from nanogs.kernels.blocks import ALL_BLOCKS, SIDE, TILE
from nanogs.kernels.gradients import CHANNELS, SUMS

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

_KEPT = 0.5  # share of a card's memory that is not returned to the system between views
_MOST = 2**30  # largest number of entries of a view: 32-bit indices, and sorting doubles the arrays


@cache
def engine_of(name: str) -> "Engine | None":
    """Return the engine of a device, "cpu" or "cuda"; None if there is no card."""
    wp.config.log_level = wp.LOG_ERROR  # no output from Warp unless it fails
    wp.init()
    if name == "cuda" and not wp.is_cuda_available():
        return None
    return Engine(wp.get_device("cuda:0" if name == "cuda" else "cpu"))


class Engine:
    """A Warp device, with the models and pictures that were copied to it.

    Attributes:
        name: Name of the device in reports.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.name = f"cuda, {device.name}" if device.is_cuda else "warp-cpu"
        self._lanes = WARP if device.is_cuda else 1
        if device.is_cuda and device.is_mempool_enabled:
            # By default each wait for the card returns all free memory to the system, which takes
            # longer than most kernels.
            wp.set_mempool_release_threshold(device, _KEPT)
        self._held: WeakKeyDictionary[object, Any] = WeakKeyDictionary()

    def held(self, owner: object, upload: "Callable[[], T]") -> "T":
        """Return what was uploaded for an object: uploaded once, and freed with the object."""
        found: T | None = self._held.get(owner)
        if found is None:
            found = self._held[owner] = upload()
        return found

    def put(self, values: Array, kind: type | None = None) -> wp.array:
        """Copy an array to the device, converted to `kind` if given."""
        values = np.ascontiguousarray(values) if kind is None else np.asarray(values, kind)
        return wp.array(values, device=self.device)

    def empty(self, shape: tuple[int, ...], kind: type) -> wp.array:
        """Allocate an uninitialised array on the device."""
        return wp.empty(shape, dtype=kind, device=self.device)

    def sums(self, count: int) -> CardSums:
        """Begin sums of the light of N splats."""
        return CardSums(self, count)

    def launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], *args: object) -> None:
        """Run a kernel with one thread for each index."""
        wp.launch(kernel, dim=dim, inputs=list(args), device=self.device)

    def launch_tiles(self, make: "Callable[[int], wp.Kernel]", tiles: int, *args: object) -> None:
        """Run a kernel with one block of threads for each tile."""
        wp.launch_tiled(
            make(self._lanes), dim=[tiles], inputs=list(args), block_dim=WARP, device=self.device
        )


class DeviceSplats:
    """A model in a device's memory; the arguments are those of `kernels.project.project_splats`."""

    def __init__(
        self,
        engine: Engine,
        means: F,
        factors: F32,
        opacities: F32,
        reaches: F32,
        keep: Bool,
        sh: F32,
        *,
        mip: bool,
    ) -> None:
        self.engine = engine
        self.count, self.mip = len(means), mip
        self.means = engine.put(means, np.float64)
        self.factors, self.sh = engine.put(factors), engine.put(sh)
        self.opacities, self.reaches = engine.put(opacities), engine.put(reaches)
        self.keep = engine.put(keep)

    def view(self, rotation: F64, position: F64, intrinsics: F64, degree: int) -> "View":
        """Project the model to a camera; the arguments are those of `project_splats`."""
        return View(self, rotation, position, intrinsics, degree)


class View:
    """A model projected to one camera, sorted by depth and listed by tile, on the device.

    Attributes:
        geometry: (N, 8) float64, see `nanogs.kernels.project`.
        features: (N,) vectors of red, green, blue and depth; undefined for splats not drawn.
    """

    def __init__(
        self, model: DeviceSplats, rotation: F64, position: F64, intrinsics: F64, degree: int
    ) -> None:
        engine, n = model.engine, model.count
        self.engine, self.count = engine, n
        self.size = wp.vec2i(int(intrinsics[4]), int(intrinsics[5]))
        self.tiles = -(-int(intrinsics[4]) // EDGE) * -(-int(intrinsics[5]) // EDGE)
        self.rotation, self.position = wp.mat33d(*rotation.ravel()), wp.vec3d(*position)
        self.intrinsics = Intrinsics(*intrinsics.tolist())  # a value, which needs no copy
        self.geometry = engine.empty((n, 8), wp.float64)
        self.features = engine.empty((n,), wp.vec4f)
        boxes, drawn = engine.empty((n,), wp.vec4i), wp.zeros(1, wp.int32, device=engine.device)
        # Sorting needs arrays of twice the length.
        self.depths, order = (engine.empty((2 * n,), kind) for kind in (wp.float32, wp.int32))
        self.starts = wp.zeros(self.tiles + 1, dtype=wp.int32, device=engine.device)
        self.entries = self.slots = self.order = engine.empty((0,), wp.int32)
        self.ends = engine.empty((0,), wp.int64)
        self.shapes = engine.empty((0,), Shape)
        self._drawn = drawn
        self._summed: dict[int, wp.array] = {}  # by the blocks that are wanted
        if n == 0:
            return
        engine.launch(
            project_splats, n, model.means, model.factors, model.opacities, model.reaches,
            model.keep, model.sh, self.rotation, self.position, self.intrinsics, model.mip, degree,
            self.geometry, self.features, boxes, self.depths, order, drawn,
        )  # fmt: skip
        self._list(boxes, order)

    @property
    def drawn(self) -> int:
        """Number of splats that can reach a pixel."""
        return int(self._drawn.numpy()[0])

    def _list(self, boxes: wp.array, order: wp.array) -> None:
        """List the splats of each tile, nearest first."""
        engine, n = self.engine, self.count
        keys = wp.clone(self.depths)
        self.order = order
        wp.utils.radix_sort_pairs(keys, order, n)
        counts, self.ends = engine.empty((n,), wp.int64), engine.empty((n,), wp.int64)
        engine.launch(count_tiles, n, self.geometry, boxes, self.order, self.size, counts)
        wp.utils.array_scan(counts, self.ends, inclusive=True)
        count = int(self.ends[n - 1 :].numpy()[0])
        if count > _MOST:
            raise ModelError(
                f"A view has {count:,} pairs of a splat and a tile that it covers, more than a"
                ' graphics card can list; use fewer pixels, or `device="cpu"`.'
            )
        self.entries = engine.empty((count,), wp.int32)
        tiles, self.slots = (engine.empty((2 * count,), wp.int32) for _ in range(2))
        owners = engine.empty((count,), wp.int32)
        self.shapes = engine.empty((count,), Shape)
        if count == 0:
            return
        engine.launch(
            write_tiles, n, self.geometry, boxes, self.order, self.size, self.ends, tiles,
            self.slots, owners,
        )  # fmt: skip
        wp.utils.radix_sort_pairs(tiles, self.slots, count, end_bit=self.tiles.bit_length())
        engine.launch(
            find_starts, count, tiles, self.slots, owners, count, self.starts, self.entries
        )
        across = -(-self.size[0] // EDGE)
        engine.launch(shape_entries, count, self.geometry, self.entries, tiles, across, self.shapes)

    def blend(
        self, features: wp.array, background: F32, wanted: int = ALL_BLOCKS
    ) -> tuple[wp.array, wp.array]:
        """Blend four features of each splat front to back.

        Args:
            features: (N,) vectors of four, on the device.
            background: (up to 4,) float32, added with the final transmittance.
            wanted: Bit mask of the blocks of each tile to blend.

        Returns:
            The image (H, W), vectors of four, and the transmittance (H, W), on the device.
        """
        width, height = self.size
        image = self.engine.empty((height, width), wp.vec4f)
        transmittance = self.engine.empty((height, width), wp.float32)
        behind = wp.vec4f(*[*background.tolist(), 0.0, 0.0, 0.0, 0.0][:CHANNELS])
        self.engine.launch(
            blend_tiles, (self.tiles, PIXELS), self.shapes, features, self.starts, self.entries,
            wanted, behind, self.size, image, transmittance,
        )  # fmt: skip
        return image, transmittance

    @staticmethod
    def to_host(image: wp.array, channels: int) -> F32:
        """Copy the first channels of an image from `blend` to the host: (H, W, channels)."""
        some = image.view(wp.float32)[:, :, :channels]
        copied: F32 = some.contiguous().numpy()
        return copied

    def in_bytes(self, wanted: int = ALL_BLOCKS) -> wp.array:
        """(H, W, 4) uint8 on the device: the image of a `fit.targets.Target` of this view."""
        width, height = self.size
        image, transmittance = self.blend(self.features, np.zeros(CHANNELS, np.float32), wanted)
        written = self.engine.empty((height, width, CHANNELS), wp.uint8)
        self.engine.launch(write_bytes, (height, width), image, transmittance, written)
        return written

    def contributions(self, wanted: int = ALL_BLOCKS) -> F64:
        """(N,) float64, sums of each splat's weight T alpha over the pixels."""
        totals: F64 = self.sums_of_weights(wanted).numpy().astype(np.float64)
        return totals

    def sums_of_weights(self, wanted: int = ALL_BLOCKS) -> wp.array:
        """(N,) float32 on the device, the same as `contributions`."""
        if wanted not in self._summed:
            width, height = self.size
            ones = wp.full((height, width), 1.0, dtype=wp.float32, device=self.engine.device)
            self._summed[wanted] = self._sums(ones, wanted)
        return self._summed[wanted]

    def total(self, count: int) -> float:
        """Return the sum of the contributions of the first `count` splats."""
        return float(wp.utils.array_sum(self.sums_of_weights()[:count])) if count else 0.0

    def errors(self, target: U8, white: float, alpha: float, counted: F32, wanted: int) -> F64:
        """(N, 2) float64, sums of T alpha times the squared residual, and of T alpha.

        Args:
            target: (H, W, 4) uint8, target image of this view.
            white: As in `weigh`.
            alpha: As in `weigh`.
            counted: (H, W), 1 for pixels that count and 0 for others.
            wanted: Bit mask of the blocks of each tile in which pixels count.
        """
        engine, (width, height) = self.engine, self.size
        image, _ = self.blend(self.tinted(white, alpha), np.zeros(CHANNELS, np.float32), wanted)
        residual, _, _ = self.weigh(image, engine.put(target), white, alpha, wanted)
        mask, squares = engine.put(counted), engine.empty((height, width), wp.float32)
        engine.launch(square_pixels, (height, width), residual, mask, squares)
        sums = [self._sums(probe, wanted).numpy() for probe in (squares, mask)]
        return np.stack(sums, axis=1).astype(np.float64)

    def _sums(self, probe: wp.array, wanted: int) -> wp.array:
        """(N,) float32 on the device, sums of each splat's weight T alpha times a probe (H, W)."""
        if not len(self.entries):
            return wp.zeros(self.count, dtype=wp.float32, device=self.engine.device)
        partial = wp.zeros(len(self.entries), dtype=wp.float32, device=self.engine.device)
        self.engine.launch_tiles(
            share_kernel, self.tiles, self.shapes, self.starts, self.slots, wanted, self.size,
            probe, partial,
        )  # fmt: skip
        return self._gathered(partial, 1).flatten()

    def _gathered(self, partial: wp.array, columns: int) -> wp.array:
        """Sum the slots of each splat: (N, K); partial: (E,) numbers, or vectors of K."""
        slots = partial.view(wp.float32).reshape((len(partial), columns))
        totals = self.engine.empty((self.count, columns), wp.float32)
        self.engine.launch(
            gather_slots, (self.count, columns), self.order, self.ends, slots, totals
        )
        return totals

    def unoccluded(self) -> F64:
        """(N,) float64, contribution of each splat if nothing were in front of it.

        This is 2 pi alpha sqrt(det) of each Gaussian whose centre is on the image, or else 0.
        """
        found: F64 = self.sums_unoccluded().numpy()
        return found

    def sums_unoccluded(self) -> wp.array:
        """(N,) float64 on the device, the same as `unoccluded`."""
        totals = self.engine.empty((self.count,), wp.float64)
        self.engine.launch(
            add_unoccluded, self.count, self.geometry, self.depths, self.size, totals
        )
        return totals

    def tinted(self, white: float, alpha: float) -> wp.array:
        """(N,) features that a fit blends: colours less `white`, and `alpha` for the depth."""
        features = self.engine.empty((self.count,), wp.vec4f)
        self.engine.launch(tint, self.count, self.features, self.depths, white, alpha, features)
        return features

    def weigh(
        self, image: wp.array, target: wp.array, white: float, alpha: float, wanted: int
    ) -> tuple[wp.array, wp.array, float]:
        """Return the residual of an image, its alpha, and the mean squared error per channel.

        The arguments are those of `nanogs.kernels.backward.weigh_pixels`, on the device.
        """
        width, height = self.size
        residual = self.engine.empty((height, width), wp.vec4f)
        curvature_weights = self.engine.empty((height, width), wp.float32)
        errors = self.engine.empty((height, width), wp.float64)
        self.engine.launch(
            weigh_pixels, (height, width), image, target, white, alpha, wanted, self.size,
            residual, curvature_weights, errors,
        )  # fmt: skip
        total = float(wp.utils.array_sum(errors.flatten()))
        pixels = _count_pixels(width, height, wanted)
        return residual, curvature_weights, total / (3 * max(pixels, 1))

    def gradients(
        self,
        features: wp.array,
        image: wp.array,
        residual: wp.array,
        curvature_weights: wp.array,
        wanted: int,
    ) -> wp.array:
        """(N, 25) float32, sums of gradient and curvature for each splat.

        They are those of `nanogs.kernels.backward.gather_entries` before
        `kernels.gradients.SCALES`; the arguments are those of
        `nanogs.kernels.backward.gradient_tiles`.
        """
        if not len(self.entries):
            return wp.zeros((self.count, SUMS), dtype=wp.float32, device=self.engine.device)
        partial = wp.zeros(len(self.entries), dtype=Sums, device=self.engine.device)
        self.engine.launch_tiles(
            pull_kernel, self.tiles, self.shapes, features, self.starts, self.entries, self.slots,
            wanted, self.size, image, residual, curvature_weights, partial,
        )  # fmt: skip
        return self._gathered(partial, SUMS)


def _count_pixels(width: int, height: int, wanted: int) -> int:
    """Count the pixels of an image that are in wanted blocks of its tiles."""
    across, down = (
        np.bincount(np.arange(size) % TILE // SIDE, minlength=TILE // SIDE)
        for size in (width, height)
    )
    blocks = np.arange(len(across) * len(down)).reshape(len(down), len(across))
    return int(((wanted >> blocks & 1) * down[:, None] * across).sum())
