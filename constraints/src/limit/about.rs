//! What a kind of limit says of itself. The page about limits, the classes of Python and the tests of every kind are made from it.

/// Whether a kind of limit forbids or resists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// Always hard: braking counts on it.
    Hard,
    /// Soft: braking comes first. `jerk` is hard with `hard = true`.
    Soft,
    /// Hard unless `soft` is given.
    Either,
}

impl Form {
    /// As the page about limits has it.
    pub fn name(self) -> &'static str {
        match self {
            Form::Hard => "hard",
            Form::Soft => "soft",
            Form::Either => "hard or soft",
        }
    }
}

/// What a user reads of a kind of limit, and what every kind is tested with.
#[derive(Debug)]
pub struct About {
    /// Name of its class in Python.
    pub class: &'static str,
    /// What it promises, in a sentence or two.
    pub promise: &'static str,
    /// A line of the task file, with the joints of a Panda.
    pub example: &'static str,
    /// Hard, soft or either.
    pub form: Form,
    /// What its margin is kept from, with the unit.
    pub margin: &'static str,
    /// A line with a margin and the line without one that holds the same; `None` where there is no bound to keep it from.
    pub stricter: Option<[&'static str; 2]>,
    /// Arguments of the Python class behind the model, in their order.
    pub arguments: &'static [Argument],
}

/// An argument of a Python class, which is a setting of the task file's section.
#[derive(Debug)]
pub struct Argument {
    /// Name in Python.
    pub name: &'static str,
    /// Key in the section, dots between the levels; empty for the section itself.
    pub key: &'static str,
    /// What it takes.
    pub takes: Takes,
    /// What it is when it is not given, as Python writes it; `None` where it has to be given.
    pub default: Option<&'static str>,
    /// It can only be given by name.
    pub by_name: bool,
}

impl Argument {
    /// One that has to be given; its key is its name.
    pub const fn needed(name: &'static str, takes: Takes) -> Argument {
        Argument { name, key: name, takes, default: None, by_name: false }
    }

    /// One that may be left out.
    pub const fn or(name: &'static str, takes: Takes, default: &'static str) -> Argument {
        Argument { default: Some(default), ..Argument::needed(name, takes) }
    }

    /// One that may be left out and is given by name.
    pub const fn named(name: &'static str, takes: Takes, default: &'static str) -> Argument {
        Argument { by_name: true, ..Argument::or(name, takes, default) }
    }

    /// The same with another key.
    pub const fn at(self, key: &'static str) -> Argument {
        Argument { key, ..self }
    }

    /// `margin`, a number.
    pub const MARGIN: Argument = Argument::named("margin", Takes::Number, "0.0");

    /// `margin`, joint by joint.
    pub const MARGINS: Argument = Argument::named("margin", Takes::PerJoint, "None");

    /// `soft`, by name.
    pub const SOFT: Argument = Argument::named("soft", Takes::Soft, "None");

    /// `name` to switch a limit on and off by.
    pub const NAME: Argument = Argument::named("name", Takes::Text, "None");

    /// `point` of a frame \[m\].
    pub const POINT: Argument = Argument::named("point", Takes::Vector, "(0.0, 0.0, 0.0)");
}

/// What an argument takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Takes {
    /// A number for all joints, by joint, or for each dof.
    PerJoint,
    /// A number.
    Number,
    /// Three numbers.
    Vector,
    /// True or false.
    Flag,
    /// A whole number.
    Count,
    /// A text.
    Text,
    /// A list of names.
    Names,
    /// A list of pairs of names.
    Pairs,
    /// Numbers by name.
    Numbers,
    /// Weights of a soft limit, linear and quadratic.
    Soft,
    /// Solids as in a task file.
    Solids,
    /// A robot's name, or curves by joint.
    Curves,
}

impl Takes {
    /// Its type in Python.
    pub fn python(self) -> &'static str {
        match self {
            Takes::PerJoint => "PerJoint",
            Takes::Number => "float",
            Takes::Vector => "Sequence[float]",
            Takes::Flag => "bool",
            Takes::Count => "int",
            Takes::Text => "str",
            Takes::Names => "Sequence[str]",
            Takes::Pairs => "Sequence[tuple[str, str]]",
            Takes::Numbers => "Mapping[str, float]",
            Takes::Soft => "tuple[float, float]",
            Takes::Solids => "Sequence[Mapping[str, Any]]",
            Takes::Curves => "str | Mapping[str, Mapping[str, float]]",
        }
    }

    /// What a wrong one is told.
    pub fn expected(self) -> &'static str {
        match self {
            Takes::PerJoint => {
                "a number for all joints, numbers by name: {\"elbow\": 1.5}, or one for each dof: [1.5, 2.0]"
            }
            Takes::Number => "a number",
            Takes::Vector => "three numbers: [0.0, 0.0, 1.0]",
            Takes::Flag => "True or False",
            Takes::Count => "a whole number of at least 0",
            Takes::Text => "a text",
            Takes::Names => "a list of names: [\"elbow\"]",
            Takes::Pairs => "a list of pairs of names: [(\"hand\", \"floor\")]",
            Takes::Numbers => "numbers by name: {\"q.elbow\": 1.0}",
            Takes::Soft => "the weights (linear, quadratic): (1.0, 100.0)",
            Takes::Solids => {
                "a list of shapes as in a task file: [{\"name\": \"floor\", \"shape\": \"half_space\"}]"
            }
            Takes::Curves => "\"fr3\", or by joint a dictionary of limit, offset, squared, lower and upper",
        }
    }
}
