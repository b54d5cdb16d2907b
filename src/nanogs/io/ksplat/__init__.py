"""`.ksplat` of GaussianSplats3D."""
