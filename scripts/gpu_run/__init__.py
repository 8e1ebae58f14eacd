"""The first run of the CUDA kernels on a machine with an NVIDIA GPU; ``scripts/gpu.py`` is its command line.

Everything except ``on_device`` needs Python alone, so that a missing package becomes a line of the report.
"""
