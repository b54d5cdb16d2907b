"""COLMAP's camera models, as far as they are pinholes."""

from dataclasses import dataclass

from nanogs.errors import FormatError


@dataclass(frozen=True, slots=True)
class Model:
    """How a COLMAP camera model lays out its parameters.

    Attributes:
        name: COLMAP's name of it.
        count: How many parameters it has.
        focals: 1 if fx and fy are one parameter, 2 if they are two.
        flattens: Whether it is a pinhole once its distortion parameters are zero; a fisheye
            is not.
    """

    name: str
    count: int
    focals: int
    flattens: bool


# The position in this list is the model's number in binary files.
MODELS = (
    Model("SIMPLE_PINHOLE", 3, 1, flattens=True),
    Model("PINHOLE", 4, 2, flattens=True),
    Model("SIMPLE_RADIAL", 4, 1, flattens=True),
    Model("RADIAL", 5, 1, flattens=True),
    Model("OPENCV", 8, 2, flattens=True),
    Model("OPENCV_FISHEYE", 8, 2, flattens=False),
    Model("FULL_OPENCV", 12, 2, flattens=True),
    Model("FOV", 5, 2, flattens=True),
    Model("SIMPLE_RADIAL_FISHEYE", 4, 1, flattens=False),
    Model("RADIAL_FISHEYE", 5, 1, flattens=False),
    Model("THIN_PRISM_FISHEYE", 12, 2, flattens=False),
)
BY_NAME = {model.name: model for model in MODELS}


@dataclass(frozen=True, slots=True)
class ColmapCamera:
    """One entry of `cameras.bin` or `cameras.txt`.

    Attributes:
        camera_id: What images refer to.
        model: Its camera model.
        size: Width and height in pixels.
        params: The model's parameters in COLMAP's order: focal lengths, principal point in pixels
            from the image's top left corner, distortion.
    """

    camera_id: int
    model: Model
    size: tuple[int, int]
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ColmapImage:
    """One entry of `images.bin` or `images.txt`.

    Attributes:
        image_id: COLMAP's number of it.
        quaternion: wxyz, world to camera.
        translation: World to camera, scene units.
        camera_id: The camera that took it.
        name: The photograph's path inside the image folder.
    """

    image_id: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str


def intrinsics(camera: ColmapCamera, where: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return a camera's focal lengths (fx, fy) and principal point (cx, cy), in pixels.

    Raises:
        FormatError: Its model bends lines: it is a fisheye, or has a distortion that is not zero.
    """
    model, params = camera.model, camera.params
    distortion = params[model.focals + 2 :]
    # Not `any`: a NaN is not zero either, and both must be refused.
    if not model.flattens or any(value != 0 for value in distortion):
        raise FormatError(
            f"{where}: camera {camera.camera_id} has model {model.name}, which is distorted; "
            "undistort photographs and cameras with colmap image_undistorter"
        )
    fx, fy = params[0], params[model.focals - 1]
    return (fx, fy), (params[model.focals], params[model.focals + 1])


def unknown_model(where: str, given: object) -> FormatError:
    """Return the error for a camera model that is not in `MODELS`."""
    return FormatError(
        f"{where}: camera model {given} is not known; "
        "undistort photographs and cameras with colmap image_undistorter"
    )
