"""Multi-scale bilinear sampling in three forms: PyTorch (reference), numba (CPU), Triton (GPU)."""
