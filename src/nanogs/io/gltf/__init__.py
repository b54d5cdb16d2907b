"""glTF with KHR_gaussian_splatting, and 3D Tiles, whose contents are glTF."""
