//! Checks that the level (instruction set) is read from the environment once: later changes of the
//! environment have no effect.

use entire_core::kernels::Level;
use libtest_mimic::{Arguments, Failed, Trial};

/// Environment variable that caps the level.
const LEVEL_VARIABLE: &str = "ENTIRE_LEVEL";

#[allow(unsafe_code, reason = "setting the environment is unsafe; this test is alone in its process")]
fn a_change_of_the_environment_after_the_first_model_changes_nothing() -> Result<(), Failed> {
    let first = Level::detect();
    Level::check_override().expect("the suite runs with a valid level or none");
    // SAFETY: this process has one test, and no other thread reads the environment.
    unsafe { std::env::set_var(LEVEL_VARIABLE, "no such level") };
    assert!(Level::check_override().is_ok(), "the environment was read again");
    // SAFETY: this process has one test, and no other thread reads the environment.
    unsafe { std::env::set_var(LEVEL_VARIABLE, "scalar") };
    assert_eq!(Level::detect(), first);
    Ok(())
}

fn main() {
    let arguments = Arguments::from_args();
    let check = a_change_of_the_environment_after_the_first_model_changes_nothing;
    libtest_mimic::run(
        &arguments,
        vec![Trial::test("a_change_of_the_environment_after_the_first_model_changes_nothing", check)],
    )
    .exit();
}
