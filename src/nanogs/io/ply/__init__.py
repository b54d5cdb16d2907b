"""Plain 3DGS `.ply` files, and what PLY files have in common."""
