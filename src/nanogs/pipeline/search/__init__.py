"""Searches for the result that reaches a file size, a PSNR or a draw cost."""
