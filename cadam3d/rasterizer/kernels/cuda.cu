// The CUDA rasterizer in one translation unit. See ../cuda.py for the order of the kernels.
#include "blend.cuh"
#include "project.cuh"
#include "sort.cuh"
#include "tiles.cuh"
