//! A network from a model file as a predictor.
