//! Training and evaluation of predictors on measured frames: splits of a timing table, inputs of a model,
//! unit costs by robust regression, PredNet by gradient descent, errors and upper bounds.

pub mod bound;
pub mod evaluation;
pub mod fit;
pub mod gradient;
pub mod inputs;
pub mod split;
pub mod teacher;
