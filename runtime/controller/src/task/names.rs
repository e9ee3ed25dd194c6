//! Names in the lists of a task file, with or without the braces that expressions ask for: `{q.left-hip}` and `q.left-hip` are the same entry.

use serde::{Deserialize, Deserializer};

/// A name without the braces around it; an expression over several names stays as it is.
pub fn bare(name: &str) -> &str {
    let inner = name.trim().strip_prefix('{').and_then(|rest| rest.strip_suffix('}'));
    inner.filter(|inner| !inner.contains(['{', '}'])).map_or(name, str::trim)
}

/// A list of names.
pub(crate) fn list<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<String>, D::Error> {
    Ok(all_bare(Vec::deserialize(from)?))
}

/// A list that may be absent.
pub(crate) fn optional<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Vec<String>>, D::Error> {
    Ok(Option::<Vec<String>>::deserialize(from)?.map(all_bare))
}

fn all_bare(names: Vec<String>) -> Vec<String> {
    names.into_iter().map(|name| bare(&name).to_string()).collect()
}

#[cfg(test)]
mod tests {
    use super::bare;

    #[test]
    fn braces_around_a_whole_name_are_dropped_and_those_of_an_expression_stay() {
        for (written, name) in [
            ("q.elbow", "q.elbow"),
            ("{q.left-hip}", "q.left-hip"),
            (" { q.left-hip } ", "q.left-hip"),
            ("{q.left-hip} - {q.right-hip}", "{q.left-hip} - {q.right-hip}"),
            ("2 * {q.left-hip}", "2 * {q.left-hip}"),
            ("{", "{"),
        ] {
            assert_eq!(bare(written), name);
        }
    }
}
