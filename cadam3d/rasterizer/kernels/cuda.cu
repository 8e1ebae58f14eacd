// The CUDA rasterizer in one translation unit. How its kernels follow one another is written in ../cuda.py.
#include "blend.cuh"
#include "project.cuh"
#include "sort.cuh"
#include "tiles.cuh"
