//! The tests of the command and its library that need no harness of their own, as one program.

mod bad_input;
mod c_log;
mod calibrate;
mod collect;
mod commands;
mod farm;
mod fill_values;
mod independent_readers;
mod predictions;
mod reference;
mod shipped_models;
mod steer;
mod train;
mod train_evaluate;
mod transfer;
mod volume_formats;

#[path = "../support/ball.rs"]
mod ball;
#[path = "../support/reference.rs"]
mod page;
#[path = "../support/mod.rs"]
mod support;
