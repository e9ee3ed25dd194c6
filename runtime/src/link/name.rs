//! Robot names, and the iceoryx2 configuration each name gets.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use iceoryx2::prelude::{Config, FileName, Path, SemanticString};

use super::{LinkError, home};

/// Name of one robot (or test) on this machine. Links of different names share no file.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct RobotName(String);

impl RobotName {
    /// Checks `name`: 1 to 32 letters, digits, `-` or `_`, beginning with a letter or digit.
    pub fn new(name: &str) -> Result<RobotName, LinkError> {
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        let starts = name.starts_with(|c: char| c.is_ascii_alphanumeric());
        if !starts || name.len() > 32 || !name.chars().all(plain) {
            return Err(LinkError::Name(name.to_owned()));
        }
        Ok(RobotName(name.to_owned()))
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Start of the names of all shared memory segments of this robot; `.` cannot occur in a name, so that no
    /// prefix is the beginning of another.
    pub(crate) fn prefix(&self) -> String {
        format!("nearl.{}.", self.0)
    }

    /// Folder of everything of this robot but iceoryx2's segments, in that of the user.
    pub(crate) fn folder(&self) -> PathBuf {
        home::of_user().join(&self.0)
    }

    /// The part of the segments' names that other users cannot guess; none while nobody has links of the robot.
    pub(crate) fn token(&self) -> Option<String> {
        home::read_token(&self.folder())
    }

    /// Start of the names of the segments there are now.
    pub(crate) fn segments(&self) -> String {
        format!("{}{}.", self.prefix(), self.token().unwrap_or_default())
    }

    /// Explicit configuration: no `config/iceoryx2.toml` of the working directory is read.
    pub(crate) fn config(&self) -> Result<Config, LinkError> {
        let mut config = Config::default();
        let fail = |reason: String| self.transport("be configured", reason);
        let folder = self.folder();
        let folder = folder.to_str().ok_or_else(|| fail("its folder is not UTF-8".into()))?;
        let root = Path::new(folder.as_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        config.global.set_root_path(&root);
        config.global.prefix =
            FileName::new(self.segments().as_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        config.global.creation_timeout = Duration::from_millis(500);
        Ok(config)
    }

    /// The error of something the transport refused: `action` is what was tried, `reason` what it said.
    pub fn transport(&self, action: impl Into<String>, reason: impl Into<String>) -> LinkError {
        LinkError::Transport {
            name: self.clone(),
            action: action.into(),
            reason: reason.into(),
            files: format!("{} and /dev/shm/{}*", self.folder().display(), self.prefix()),
        }
    }
}

impl fmt::Display for RobotName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_break_files_are_refused() {
        for bad in ["", "-a", "a/b", "a.b", "a b", "..", "\u{e9}", "a123456789012345678901234567890123"] {
            let error = RobotName::new(bad).unwrap_err();
            assert!(error.to_string().contains("letters, digits"), "{error}");
        }
        assert_eq!(RobotName::new("panda-2_left").unwrap().as_str(), "panda-2_left");
    }
}
