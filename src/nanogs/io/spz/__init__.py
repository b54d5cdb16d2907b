"""Niantic's `.spz`: columns of bytes, packed by gzip or zstd."""
