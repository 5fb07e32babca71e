//! PredNet training and fine-tuning.
