//! Predictors made from measured frames, and how right they are: splits of a timing table, inputs of a model, unit
//! costs by least squares, PredNet by gradient descent, evaluation.

pub mod bound;
pub mod evaluation;
pub mod fit;
pub mod gradient;
pub mod inputs;
pub mod split;
pub mod teacher;
