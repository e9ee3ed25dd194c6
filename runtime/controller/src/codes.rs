//! How codes are declared, and the codes of the controller: what a tick's projection and a snapshot may say.
//!
//! A code is declared once, with its enum variant, by a macro of this module. `nearl explain` prints them all.

/// Declares an enum whose variants carry a stable name, a meaning and a remedy. The number of a variant is its place.
#[macro_export]
macro_rules! codes {
    ($(#[$meta:meta])* $name:ident, $group:literal { $($variant:ident = $code:literal, $meaning:literal, $remedy:literal;)+ }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
        pub enum $name {
            $(#[doc = $meaning] #[serde(rename = $code)] $variant,)+
        }

        impl $name {
            /// All of them, in the order of their numbers.
            pub const ALL: &'static [$name] = &[$($name::$variant),+];

            /// The number in a message.
            pub fn code(self) -> u32 {
                self as u32
            }

            /// The stable name, as logs and `nearl explain` have it.
            pub fn name(self) -> &'static str {
                match self { $($name::$variant => $code,)+ }
            }

            /// Name, meaning and remedy.
            pub fn explanation(self) -> $crate::codes::Explanation {
                match self {
                    $($name::$variant => $crate::codes::Explanation {
                        code: $code, group: $group, meaning: $meaning, remedy: $remedy,
                    },)+
                }
            }

            /// What each of them means, in that order.
            pub fn explanations() -> Vec<$crate::codes::Explanation> {
                Self::ALL.iter().map(|code| code.explanation()).collect()
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(self.name())
            }
        }
    };
}
mod tables;

pub use tables::{LedgerStatus, SnapshotCode};

/// What a code means and what to do about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Explanation {
    /// Stable name.
    pub code: &'static str,
    /// Where it appears: `mode`, `reason`, `status`, `verdict`, `snapshot`, `link`, `doctor` or `rollout`.
    pub group: &'static str,
    /// What happened.
    pub meaning: &'static str,
    /// The next step.
    pub remedy: &'static str,
}
