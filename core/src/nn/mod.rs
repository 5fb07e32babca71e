//! Networks in plain meaning: dense, convolution, activation, PredNet, VolumeNet. Speed lives in `kernels`.
