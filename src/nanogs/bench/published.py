"""Published figures of other methods, to compare ours with.

From the comparison in CVT-GS (2026): NanoGS is arXiv 2603.16103 on a CPU; the others are
LightGaussian, PUP 3D-GS and GHAP; 3DGS is the model before simplification. Scores are against
photographs of the test split, outputs without fine-tuning. LPIPS, SSIM and seconds were published
for some methods only.
"""

from collections.abc import Mapping
from dataclasses import dataclass

CITATION = "CVT-GS, 2026, its comparison of methods without fine-tuning on four data sets"
RATIOS = (0.1, 0.01, 0.001)


@dataclass(frozen=True, slots=True)
class Figures:
    """Published figures of one method on one data set; None if a figure was not published.

    Attributes:
        psnr: Mean over the scenes, dB, by compaction ratio; 1 is the model itself.
        ssim: At ratio 0.1, or of the model itself.
        lpips: At ratio 0.1, or of the model itself.
        seconds: At ratio 0.1.
    """

    psnr: Mapping[float, float]
    ssim: float | None = None
    lpips: float | None = None
    seconds: float | None = None


@dataclass(frozen=True, slots=True)
class PublishedDataset:
    """A data set of the published table.

    Attributes:
        title: Its name in the table.
        scenes: Number of its scenes.
        original: Figures of 3DGS, before simplification.
        methods: Figures by method.
    """

    title: str
    scenes: int
    original: Figures
    methods: Mapping[str, Figures]


def _at(
    tenth: float,
    hundredth: float,
    thousandth: float,
    ssim: float | None = None,
    lpips: float | None = None,
    seconds: float | None = None,
) -> Figures:
    by_ratio = dict(zip(RATIOS, (tenth, hundredth, thousandth), strict=True))
    return Figures(by_ratio, ssim, lpips, seconds)


def _whole(psnr: float, ssim: float, lpips: float) -> Figures:
    return Figures({1.0: psnr}, ssim, lpips)


DATASETS: Mapping[str, PublishedDataset] = {
    "nerf-synthetic": PublishedDataset(
        "NeRF-Synthetic", 8, _whole(33.47, 0.970, 0.030),
        {
            "NanoGS": _at(25.81, 22.28, 19.04, 0.910, 0.092, 11),
            "CVT-GS": _at(27.76, 23.75, 20.18, 0.936, 0.079, 4),
            "LightGaussian": _at(21.88, 15.76, 12.64, 0.888, 0.097),
            "PUP": _at(20.24, 13.26, 11.31),
            "GHAP": _at(21.19, 13.40, 11.25),
        },
    ),
    "mip-nerf-360": PublishedDataset(
        "Mip-NeRF 360", 9, _whole(27.43, 0.813, 0.221),
        {
            "NanoGS": _at(21.97, 19.39, 17.20, 0.582, 0.432, 150),
            "CVT-GS": _at(23.45, 20.57, 18.11, 0.665, 0.366, 14),
            "LightGaussian": _at(19.38, 14.39, 11.97, 0.588, 0.412),
            "PUP": _at(15.96, 10.89, 9.32),
            "GHAP": _at(17.35, 10.62, 8.52),
        },
    ),
    "tanks-and-temples": PublishedDataset(
        "Tanks & Temples", 2, _whole(23.61, 0.843, 0.169),
        {
            "NanoGS": _at(17.94, 15.29, 13.54, 0.626, 0.413, 58),
            "CVT-GS": _at(19.66, 16.61, 14.50, 0.712, 0.324, 8),
            "LightGaussian": _at(17.50, 12.30, 9.36, 0.642, 0.357),
            "PUP": _at(13.65, 9.11, 7.40),
            "GHAP": _at(15.34, 8.43, 5.33),
        },
    ),
    "deep-blending": PublishedDataset(
        "Deep Blending", 2, _whole(29.69, 0.907, 0.238),
        {
            "NanoGS": _at(26.29, 23.12, 19.42, 0.839, 0.371, 104),
            "CVT-GS": _at(27.42, 24.35, 20.52, 0.864, 0.317, 12),
            "LightGaussian": _at(24.28, 18.28, 13.41, 0.816, 0.351),
            "PUP": _at(19.90, 10.91, 8.23),
            "GHAP": _at(21.75, 11.36, 7.56),
        },
    ),
}  # fmt: skip

# The usual protocol scales photographs to a quarter of their width outdoors, to half indoors.
_INDOORS = frozenset({"room", "counter", "kitchen", "bonsai"})
IMAGE_SCALES = {"images_4": "a quarter", "images_2": "half"}


def image_folder(dataset: str, scene: str) -> str | None:
    """Return the photograph folder of the usual protocol, or None for the dataset's default."""
    if dataset != "mip-nerf-360":
        return None
    return "images_2" if scene in _INDOORS else "images_4"
