//! Numbers for names, in the order in which the names first appear.

use std::collections::HashMap;

/// Numbers of volumes or scenes by their names.
#[derive(Default)]
pub struct Groups(HashMap<String, u64>);

impl Groups {
    /// Returns the number of a name; a new name gets the next free number.
    pub fn number(&mut self, name: &str) -> u64 {
        let next = self.0.len() as u64;
        *self.0.entry(name.to_owned()).or_insert(next)
    }
}
