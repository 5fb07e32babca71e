//! The environment is asked for the level once: a host that changes it later, from another thread, disturbs
//! nothing.

use entire_core::kernels::{LEVEL_VARIABLE, Level};

#[test]
#[allow(unsafe_code, reason = "setting the environment is unsafe; this test is alone in its process")]
fn a_change_of_the_environment_after_the_first_model_changes_nothing() {
    let first = Level::detect();
    Level::check_override().expect("the suite runs with a valid level or none");
    // SAFETY: this process has one test, and no other thread reads the environment.
    unsafe { std::env::set_var(LEVEL_VARIABLE, "no such level") };
    assert!(Level::check_override().is_ok(), "the environment was read again");
    // SAFETY: as above.
    unsafe { std::env::set_var(LEVEL_VARIABLE, "scalar") };
    assert_eq!(Level::detect(), first);
}
