//! Makes of the registry's lines the task file's section, the kinds of rows and [`REGISTRY`](super::REGISTRY). Python's classes, the page about
//! limits and the tests of every kind are made from that list.

use super::{About, ConstraintSettings, Kind, Limit};

/// One kind of limit.
pub struct RegisteredLimit {
    /// Name in the task file.
    pub name: &'static str,
    /// What its rows, cones and bounds are called in reports.
    pub kind: Kind,
    /// It may stand several times in a task file, in a list.
    pub many: bool,
    /// What it says of itself.
    pub about: &'static About,
    /// Makes the limits that the task file's section asks for.
    pub build: fn(&ConstraintSettings) -> Vec<Box<dyn Limit>>,
}

/// From each line the field of [`ConstraintSettings`], the variant of [`Kind`] and the entry of [`REGISTRY`]. The number of a kind stands in logs and
/// stays as it is; the name behind it is the one in reports.
macro_rules! limits {
    ($($key:ident: $settings:ty => $module:ident::$limit:ident, $kind:ident = $number:literal $report:literal;)*) => {
        /// `[constraints]`: how proposals are made consistent and which limits hold. A limit that is not named does not hold.
        #[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct ConstraintSettings {
            /// `"kinematic"` (default) or `"free"`.
            pub consistency: crate::Consistency,
            /// `"ladder"` (default) or `"clarabel"`.
            pub solver: crate::Solver,
            /// `"auto"` (default), `"certified"` or `"stored"`.
            pub braking: crate::Braking,
            /// `true`: actions of a policy and of a learned inverse model lead to a projected state too.
            #[serde(skip_serializing_if = "crate::Guard::is_off")]
            pub guard: crate::Guard,
            /// The share of control ticks whose reached state may be outside a position limit: of policies whose actions come out of a network.
            #[serde(skip_serializing_if = "Option::is_none")]
            pub reached: Option<f64>,
            $(
                #[doc = concat!("Settings of [`", stringify!($limit), "`].")]
                #[serde(skip_serializing_if = "settings::Section::is_absent")]
                pub $key: $settings,
            )*
            /// `action = { power = 20.0 }`; of policies whose actions come out of a network, see [`ActionLimit`](crate::ActionLimit).
            #[serde(skip_serializing_if = "Option::is_none")]
            pub action: Option<ActionSettings>,
        }

        /// What set a bound, or what a violation violates.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[repr(u8)]
        pub enum Kind {
            /// Braking in front of a position limit.
            Viability = 3,
            $(
                #[doc = concat!("A [`", stringify!($limit), "`].")]
                $kind = $number,
            )*
        }

        impl Kind {
            /// All kinds, in the order of their numbers.
            pub const ALL: [Kind; 1 + [$($number),*].len()] = {
                let mut all = [Kind::Viability; 1 + [$($number),*].len()];
                $(all[$number] = Kind::$kind;)*
                all
            };

            /// Its name in reports: `"torque_speed"`.
            pub fn name(self) -> &'static str {
                match self {
                    Kind::Viability => "viability",
                    $(Kind::$kind => $report,)*
                }
            }
        }

        /// All kinds of limits by their name in the task file.
        pub const REGISTRY: &[registry::RegisteredLimit] = &[$(
            registry::RegisteredLimit {
                name: stringify!($key),
                kind: Kind::$kind,
                many: <$settings as settings::Section>::MANY,
                about: &$module::ABOUT,
                build: |settings| {
                    let each = settings.$key.as_slice().iter();
                    each.map(|s| Box::new($module::$limit::new(s.clone())) as Box<dyn Limit>).collect()
                },
            },
        )*];
    };
}

pub(super) use limits;
