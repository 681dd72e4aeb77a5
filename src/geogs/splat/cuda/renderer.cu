// The disk renderer, forward and backward, for several views in one launch of each kernel.
#include "binning.cuh"
#include "blend.cuh"
#include "project_backward.cuh"
