// The mapping losses of a window of views with their gradients, see window.py.
#include "enlargement.cuh"
#include "median.cuh"
#include "motion.cuh"
#include "ncc.cuh"
#include "single_view.cuh"
#include "ssim.cuh"
