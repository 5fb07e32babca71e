//! Recently opened volumes.

use anyhow::Result;
use entire_io::files::{make_folder_of, write_whole};
use std::path::{Path, PathBuf};

/// Maximum number of files in the list.
const MAX_FILES: usize = 12;

/// Paths, the most recent first, stored in the user's state folder.
#[derive(Clone, Debug, Default)]
pub(crate) struct Recent {
    file: Option<PathBuf>,
    pub(crate) paths: Vec<PathBuf>,
}

impl Recent {
    /// Reads the saved list; the list is empty if there is none.
    pub(crate) fn load() -> Self {
        let variable = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
        let folder = variable("XDG_STATE_HOME")
            .or_else(|| variable("HOME").map(|home| home.join(".local/state")))
            .or_else(|| variable("LOCALAPPDATA"));
        Self::read(folder.map(|f| f.join("entire/recent.json")))
    }

    fn read(file: Option<PathBuf>) -> Self {
        let text = file.as_ref().and_then(|f| std::fs::read_to_string(f).ok());
        let mut paths: Vec<PathBuf> = text.and_then(|t| serde_json::from_str(&t).ok()).unwrap_or_default();
        paths.truncate(MAX_FILES);
        Self { file, paths }
    }

    /// Puts a file first and stores the list, except paths that are not UTF-8, which JSON cannot hold. Errors
    /// are ignored, since the list is only a convenience.
    pub(crate) fn add(&mut self, path: &Path) {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        self.paths.retain(|p| *p != path);
        self.paths.insert(0, path);
        self.paths.truncate(MAX_FILES);
        if let Some(file) = &self.file {
            let keep = || -> Result<()> {
                make_folder_of(file)?;
                let paths: Vec<&str> = self.paths.iter().filter_map(|path| path.to_str()).collect();
                write_whole(file, serde_json::to_string_pretty(&paths)?.as_bytes())
            };
            let _ = keep();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_one_stands_first_once() {
        let folder = tempfile::tempdir().unwrap();
        let file = Some(folder.path().join("state/recent.json"));
        let mut recent = Recent::read(file.clone());
        for name in ["/a", "/b", "/a"] {
            recent.add(Path::new(name));
        }
        assert_eq!(recent.paths, [PathBuf::from("/a"), PathBuf::from("/b")]);
        assert_eq!(Recent::read(file).paths, recent.paths);
    }

    #[test]
    #[cfg(unix)]
    fn a_path_that_is_not_utf8_does_not_keep_others_from_being_stored() {
        use std::os::unix::ffi::OsStrExt;
        let folder = tempfile::tempdir().unwrap();
        let file = Some(folder.path().join("recent.json"));
        let mut recent = Recent::read(file.clone());
        recent.add(Path::new(std::ffi::OsStr::from_bytes(b"/\xff")));
        recent.add(Path::new("/a"));
        assert_eq!(recent.paths.len(), 2);
        assert_eq!(Recent::read(file).paths, [PathBuf::from("/a")]);
    }
}
