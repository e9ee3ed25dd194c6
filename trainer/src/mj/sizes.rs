//! Looks at what a robot file asks MuJoCo to make room for, before MuJoCo compiles it: a few letters may ask for more memory than there is,
//! and MuJoCo reserves what they ask for.
//!
//! Tags are read as they stand, not as MuJoCo's parser would: only numbers that ask for room matter here.

use std::path::{Path, PathBuf};

use nearl_runtime::constraints::{MAX_TEXT_BYTES, read_bounded};

/// Numbers that one element may ask for: pixels, heights, user data.
const NUMBERS: f64 = 16e6;
/// Elements of a robot, copies included.
const ELEMENTS: f64 = 2e5;
/// Joints of a robot, copies included.
const JOINTS: f64 = 2000.0;
/// Working memory that a file may ask for [bytes].
const MEMORY: f64 = (1_u64 << 30) as f64;
/// Elements within each other.
const DEPTH: usize = 400;
/// Files that include each other: a kitchen has some dozens.
const INCLUDES: usize = 256;

/// Attributes whose numbers, multiplied, are how many numbers or copies an element asks for; an empty element is any.
const ASKS: &[(&str, &[&str])] = &[
    ("hfield", &["nrow", "ncol"]),
    ("texture", &["width", "height"]),
    ("numeric", &["size"]),
    ("user", &["dim"]),
    ("", &["resolution"]),
    ("", &["nsample"]),
    ("", &["actdim"]),
    ("size", &["nuserdata"]),
    ("size", &["nkey"]),
    ("size", &["njmax"]),
    ("size", &["nconmax"]),
    ("size", &["nstack"]),
    ("size", &["nuser_body"]),
    ("size", &["nuser_jnt"]),
    ("size", &["nuser_geom"]),
    ("size", &["nuser_site"]),
    ("size", &["nuser_cam"]),
    ("size", &["nuser_tendon"]),
    ("size", &["nuser_actuator"]),
    ("size", &["nuser_sensor"]),
];
/// Elements that make copies: of themselves, and of what they hold.
const COPIES: [&str; 3] = ["replicate", "composite", "flexcomp"];

/// Refuses a file that asks for too much, itself or by what it includes or attaches from `folder`, and one that names what is no regular file: a pipe would be
/// waited for.
///
/// # Errors
/// One sentence with element, attribute, number and limit.
pub(super) fn check(text: &str, folder: Option<&Path>) -> Result<(), String> {
    Count {
        elements: 0.0,
        joints: 0.0,
        files: 0,
        folder: folder.map(Path::to_owned),
        models: Vec::new(),
        within: Vec::new(),
    }
    .file(text, 1.0, 0)
}

struct Count {
    elements: f64,
    joints: f64,
    files: usize,
    folder: Option<PathBuf>,
    /// Models that may be attached: name, elements and joints.
    models: Vec<(String, [f64; 2])>,
    /// Files of models within which this one stands.
    within: Vec<PathBuf>,
}

/// Folders, beside that of the file, in which the files that its elements name may lie.
const FOLDERS: [&str; 3] = ["assetdir", "meshdir", "texturedir"];

impl Count {
    /// A text in which every element stands for `copies`, within `depth` others.
    fn file(&mut self, text: &str, copies: f64, depth: usize) -> Result<(), String> {
        let mut open = vec![copies];
        let stated = tags(text).filter(|tag| tag.name == "compiler");
        let folders: Vec<&str> = std::iter::once("")
            .chain(
                stated.flat_map(|tag| FOLDERS.iter().filter_map(move |key| attribute(tag.attributes, key))),
            )
            .collect();
        for tag in tags(text) {
            let Tag { name, attributes, kind } = tag;
            let copies = open.last().copied().unwrap_or(1.0);
            if kind == Kind::Close {
                if open.len() > 1 {
                    open.pop();
                }
                continue;
            }
            let copies = copies * self.element(name, attributes, copies)?;
            self.named(name, attributes, &folders)?;
            match name {
                "include" => self.include(attributes, copies, depth + open.len())?,
                "model" => self.model(attributes, copies, depth + open.len())?,
                "attach" => self.attach(attributes, copies)?,
                _ => {}
            }
            if kind == Kind::Open {
                open.push(copies);
                let deep = depth + open.len();
                if deep > DEPTH {
                    return Err(format!("<{name}> stands within more than {DEPTH} others: nest them less"));
                }
            }
        }
        Ok(())
    }

    /// Looks at one element that stands for `copies`; returns how many copies of what it holds it makes.
    fn element(&mut self, name: &str, attributes: &str, copies: f64) -> Result<f64, String> {
        let is_copying = COPIES.contains(&name);
        let own = if is_copying { product(attributes, "count").unwrap_or(1.0).max(1.0) } else { 1.0 };
        self.elements += copies * if name == "replicate" { 1.0 } else { own };
        if ["joint", "freejoint"].contains(&name) {
            self.joints += copies;
        }
        self.is_within(name, copies * own)?;
        for (_, keys) in ASKS.iter().filter(|(element, _)| element.is_empty() || *element == name) {
            let numbers = keys.iter().filter_map(|key| product(attributes, key)).product::<f64>();
            if copies * numbers > NUMBERS {
                let keys = keys.join(" x ");
                return Err(format!(
                    "<{name}> {keys} asks for {:.0} numbers, {NUMBERS:.0} at most: write a smaller one",
                    copies * numbers
                ));
            }
        }
        if let Some(memory) = attribute(attributes, "memory").filter(|_| name == "size").map(bytes)
            && memory > MEMORY
        {
            return Err(format!(
                "<size> memory asks for {memory:.0} bytes, {MEMORY:.0} at most: write a smaller one"
            ));
        }
        Ok(own)
    }

    fn is_within(&self, name: &str, copied: f64) -> Result<(), String> {
        for (most, found, what) in [(ELEMENTS, self.elements, "elements"), (JOINTS, self.joints, "joints")] {
            if found > most || copied > ELEMENTS {
                return Err(format!(
                    "<{name}> makes {:.0} {what} of the file, {most:.0} at most: leave some out, or copy fewer",
                    found.max(copied)
                ));
            }
        }
        Ok(())
    }

    /// Refuses a file that an element names and that is there, but is no regular one.
    fn named(&self, name: &str, attributes: &str, folders: &[&str]) -> Result<(), String> {
        let Some(folder) = &self.folder else { return Ok(()) };
        for key in ["file", "filename"] {
            let Some(file) = attribute(attributes, key) else { continue };
            let bare = file.rsplit('/').next().unwrap_or_default();
            for at in
                folders.iter().flat_map(|within| [file, bare].map(|file| folder.join(within).join(file)))
            {
                let is_odd = std::fs::metadata(&at).is_ok_and(|facts| !facts.is_file() && !facts.is_dir());
                if is_odd {
                    return Err(format!(
                        "<{name}> names '{}', which is no regular file: give one",
                        at.display()
                    ));
                }
            }
        }
        Ok(())
    }

    /// A model that may be attached, with all that it attaches itself.
    fn model(&mut self, attributes: &str, copies: f64, depth: usize) -> Result<(), String> {
        let (Some(folder), Some(file)) = (&self.folder, attribute(attributes, "file")) else { return Ok(()) };
        let at = folder.join(file);
        self.files += 1;
        if self.files > INCLUDES {
            return Err(format!("<model> '{file}' is one of more than {INCLUDES} files: attach fewer"));
        }
        if self.within.contains(&at) {
            return Err(format!("<model> '{file}' attaches itself: take it out of that file"));
        }
        let Ok(bytes) = read_bounded(&at, MAX_TEXT_BYTES, true) else { return Ok(()) };
        let folder = at.parent().map(Path::to_owned);
        let mut own = Count {
            elements: 0.0,
            joints: 0.0,
            files: self.files,
            folder,
            models: Vec::new(),
            within: [&self.within[..], std::slice::from_ref(&at)].concat(),
        };
        own.file(&String::from_utf8_lossy(&bytes), 1.0, depth)?;
        self.files = own.files;
        self.elements += copies * own.elements;
        let stem =
            Path::new(file).file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
        let name = attribute(attributes, "name").map_or(stem, str::to_owned);
        self.models.push((name, [own.elements, own.joints]));
        self.is_within("model", copies)
    }

    fn attach(&mut self, attributes: &str, copies: f64) -> Result<(), String> {
        let name = attribute(attributes, "model").unwrap_or_default();
        let of_name = self.models.iter().find(|(known, _)| known == name).map(|(_, counts)| *counts);
        let most = |k: usize| self.models.iter().map(|(_, counts)| counts[k]).fold(0.0, f64::max);
        let [elements, joints] = of_name.unwrap_or_else(|| [most(0), most(1)]);
        self.elements += copies * elements;
        self.joints += copies * joints;
        self.is_within("attach", copies)
    }

    fn include(&mut self, attributes: &str, copies: f64, depth: usize) -> Result<(), String> {
        let (Some(folder), Some(file)) = (self.folder.clone(), attribute(attributes, "file")) else {
            return Ok(());
        };
        self.files += 1;
        if self.files > INCLUDES {
            return Err(format!(
                "<include> '{file}' is one of more than {INCLUDES} files: join some of them"
            ));
        }
        // What cannot be read, MuJoCo names in its own words.
        let Ok(bytes) = read_bounded(&folder.join(file), MAX_TEXT_BYTES, true) else { return Ok(()) };
        self.file(&String::from_utf8_lossy(&bytes), copies, depth)
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Open,
    Close,
    /// `<a/>`.
    Empty,
}

struct Tag<'a> {
    name: &'a str,
    attributes: &'a str,
    kind: Kind,
}

/// The tags of a text in order, without comments, declarations and instructions.
fn tags(text: &str) -> impl Iterator<Item = Tag<'_>> {
    let mut rest = text;
    std::iter::from_fn(move || {
        loop {
            rest = &rest[rest.find('<')? + 1..];
            if let Some(comment) = rest.strip_prefix("!--") {
                rest = &comment[comment.find("-->")?..];
                continue;
            }
            if rest.starts_with(['!', '?']) {
                continue;
            }
            let end = tag_end(rest)?;
            let (inside, after) = rest.split_at(end);
            rest = after;
            let (inside, kind) = match (inside.strip_prefix('/'), inside.strip_suffix('/')) {
                (Some(inside), _) => (inside, Kind::Close),
                (None, Some(inside)) => (inside, Kind::Empty),
                (None, None) => (inside, Kind::Open),
            };
            let (name, attributes) = inside.split_once(char::is_whitespace).unwrap_or((inside, ""));
            return Some(Tag { name, attributes, kind });
        }
    })
}

/// Where the tag ends: the first `>` outside of quotes.
fn tag_end(text: &str) -> Option<usize> {
    let mut quote = None;
    for (at, c) in text.char_indices() {
        match (c, quote) {
            ('>', None) => return Some(at),
            ('"' | '\'', None) => quote = Some(c),
            (c, Some(q)) if c == q => quote = None,
            _ => {}
        }
    }
    None
}

/// The value of an attribute.
fn attribute<'a>(attributes: &'a str, key: &str) -> Option<&'a str> {
    let mut rest = attributes;
    loop {
        let (name, after) = rest.split_once('=')?;
        let after = after.trim_start();
        let quote = after.chars().next().filter(|c| ['"', '\''].contains(c))?;
        let (value, next) = after[1..].split_once(quote)?;
        if name.trim() == key {
            return Some(value);
        }
        rest = next;
    }
}

/// The product of an attribute's numbers, those below 1 left out; none without the attribute.
fn product(attributes: &str, key: &str) -> Option<f64> {
    let numbers = attribute(attributes, key)?.split_whitespace().filter_map(|word| word.parse::<f64>().ok());
    Some(numbers.map(|x| x.max(1.0)).product())
}

/// `15M` in bytes; 0 for what is no size.
fn bytes(text: &str) -> f64 {
    let text = text.trim();
    let (digits, unit) = text.split_at(text.trim_end_matches(|c: char| c.is_ascii_alphabetic()).len());
    let power =
        ["", "k", "m", "g", "t", "p", "e"].iter().position(|u| unit.eq_ignore_ascii_case(u)).unwrap_or(0);
    digits.parse::<f64>().unwrap_or(0.0) * 1024_f64.powi(power as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(inside: &str) -> String {
        check(&format!("<mujoco>{inside}</mujoco>"), None).expect_err(inside)
    }

    #[test]
    fn bombs_are_named_with_element_number_and_limit() {
        for (inside, words) in [
            ("<size nuserdata=\"2000000000\"/>", "<size> nuserdata asks for 2000000000 numbers"),
            ("<size memory=\"15G\"/>", "<size> memory asks for 16106127360 bytes"),
            (
                "<asset><hfield name='a' nrow='100000' ncol = \"100000\"/></asset>",
                "<hfield> nrow x ncol asks for 10000000000",
            ),
            ("<asset><texture width=\"1e5\" height=\"1e5\"/></asset>", "<texture> width x height"),
            ("<custom><numeric name=\"n\" size=\"2000000000\"/></custom>", "<numeric> size"),
            ("<sensor><user name=\"u\" dim=\"2000000000\"/></sensor>", "<user> dim"),
            (
                "<a><replicate count=\"1000\"><replicate count=\"1000\"><geom/></replicate></replicate></a>",
                "<replicate> makes",
            ),
            (
                "<worldbody><composite count=\"1000 1000 1000\"/></worldbody>",
                "<composite> makes 1000000002 elements",
            ),
            (
                "<!-- <size/> --><replicate count=\"100\"><hfield nrow=\"1000\" ncol=\"1000\"/></replicate>",
                "<hfield>",
            ),
        ] {
            let text = said(inside);
            assert!(text.contains(words) && text.contains("at most"), "'{words}' is not in: {text}");
        }
        assert!(said(&"<body><joint/></body>".repeat(2001)).contains("<joint> makes 2001 joints"));
        assert!(said(&"<geom/>".repeat(200_001)).contains("elements"));
        assert!(said(&"<body>".repeat(500)).contains("stands within more than 400"));
    }

    /// Files of a few letters each: one that names itself, a chain in which each attaches the one before twice, and pipes.
    #[test]
    fn models_are_followed_and_pipes_are_refused() {
        let folder = std::env::temp_dir().join(format!("nearl-sizes-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("folder");
        let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).expect("written");
        let said = |text: &str| check(text, Some(&folder)).map_or_else(|e| e, |()| String::new());
        let own = "<mujoco><asset><model name=\"m\" file=\"own.xml\"/></asset></mujoco>";
        write("own.xml", own);
        assert!(said(own).contains("'own.xml' attaches itself"), "{}", said(own));
        let body = |name: &str| {
            format!("<worldbody><body name=\"{name}\"><joint/><geom size=\"1\"/></body></worldbody>")
        };
        write("x0.xml", &format!("<mujoco>{}</mujoco>", body("b")));
        let chain = |k: usize| {
            let attach = "<attach model=\"m\" body=\"b\" prefix=\"p\"/>";
            format!(
                "<mujoco><asset><model name=\"m\" file=\"x{}.xml\"/></asset><worldbody><body name=\"b\">{attach}{attach}</body></worldbody></mujoco>",
                k - 1
            )
        };
        (1..30).for_each(|k| write(&format!("x{k}.xml"), &chain(k)));
        assert_eq!(said(&chain(3)), "");
        assert!(
            said(&chain(25)).contains("<attach> makes") && said(&chain(25)).contains("of the file"),
            "{}",
            said(&chain(25))
        );
        let pipe = folder.join("pipe");
        let path = std::ffi::CString::new(pipe.to_str().expect("text")).expect("path");
        // SAFETY: plain call with a path that ends with a zero.
        assert_eq!(unsafe { libc::mkfifo(path.as_ptr(), 0o600) }, 0);
        for text in [
            "<mujoco><include file=\"pipe\"/></mujoco>",
            "<mujoco><compiler meshdir=\".\"/><asset><mesh file=\"pipe\"/></asset></mujoco>",
            "<robot><link><collision><geometry><mesh filename=\"package://x/pipe\"/></geometry></collision></link></robot>",
        ] {
            assert!(said(text).contains("pipe', which is no regular file"), "{text}: {}", said(text));
        }
        std::fs::remove_dir_all(&folder).expect("removed");
    }

    #[test]
    fn what_robots_ask_for_is_let_through() {
        let usual = "<?xml version=\"1.0\"?><mujoco><size memory=\"64M\" nuserdata='1000'/><asset><texture width=\"4096\" height=\"2048\"/>\
             <hfield nrow=\"2000\" ncol=\"2000\"/></asset><worldbody><replicate count=\"50\"><body><joint range=\"-1e9 1e9\"/></body></replicate>\
             </worldbody></mujoco>";
        check(usual, None).unwrap_or_else(|e| panic!("{e}"));
        for odd in ["", "<", "<a", "<a b=", "<a b=\"", "</a></a>", "<!--", "<a b=c>", "<size memory=\"G\"/>"]
        {
            check(odd, None).unwrap_or_else(|e| panic!("{odd}: {e}"));
        }
    }
}
