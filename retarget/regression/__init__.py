"""From a motion to the garment's coefficients: linear, by kernels, by an LSTM."""
