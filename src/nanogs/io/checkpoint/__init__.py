"""Checkpoints of trainers, which PyTorch saved."""
