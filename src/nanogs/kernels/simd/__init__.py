"""Small functions of the hottest kernels, written with LLVM's vector types; see README.md."""
