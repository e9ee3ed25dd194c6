//! The metadata of an ONNX file as a recipe: our own, or mjlab's.

mod mjlab;
mod velocimeter;

use super::{ImportError, ImportedNetwork};
use nearl_runtime::constraints::MAX_TASK_BYTES;
use toml::{Table, Value};

pub(super) use velocimeter::place;

/// Key of the recipe in files of `nearl export`: a task file in TOML.
pub(crate) const RECIPE: &str = "nearl_recipe";

/// What the metadata says, as sections of a task file; empty where it says nothing. What one of the `recipes` states is not looked at in mjlab's.
pub(super) fn recipe(network: &ImportedNetwork, recipes: &[Table]) -> Result<Table, ImportError> {
    if let Some(text) = network.metadata.get(RECIPE) {
        let refuse =
            |e: toml::de::Error| ImportError::Metadata { key: RECIPE.into(), reason: e.message().into() };
        if text.len() as u64 > MAX_TASK_BYTES {
            let reason = format!("it has {} bytes, more than the limit of {MAX_TASK_BYTES}", text.len());
            return Err(ImportError::Metadata { key: RECIPE.into(), reason });
        }
        return toml::from_str(text).map_err(refuse);
    }
    if is_exported_change(network) {
        let reason = "the file's output 'change' is a change of state that 'nearl export' wrote of a policy that proposes, and a recipe is of a policy of \
                      actions; import it into its task (--task FILE --actions change, in Python task= and actions='change')";
        return Err(ImportError::Recipe(reason.into()));
    }
    if is_of_mjlab(network) {
        return mjlab::recipe(network, recipes);
    }
    Ok(Table::new())
}

/// Whether its keys are mjlab's, and no recipe of ours is beside them.
fn is_of_mjlab(network: &ImportedNetwork) -> bool {
    let has = |key: &str| network.metadata.contains_key(key);
    !has(RECIPE) && has("observation_names") && has("joint_names")
}

/// Whether one of the recipes states a key of `[policy]`.
fn states(recipes: &[Table], key: &str) -> bool {
    recipes.iter().any(|recipe| recipe.get("policy").is_some_and(|policy| policy.get(key).is_some()))
}

/// The keys of `[constraints]` in the metadata: limits that an import without a recipe has, and one with a recipe that does not say otherwise.
pub fn brought(network: &ImportedNetwork) -> Vec<String> {
    let table = recipe(network, &[]).unwrap_or_default();
    let limits = table.get("constraints").and_then(Value::as_table);
    limits.map_or(Vec::new(), |limits| limits.keys().cloned().collect())
}

/// Whether 'nearl export' wrote it of a policy that proposes: then the outputs are in the units of the state.
pub(super) fn is_exported_change(network: &ImportedNetwork) -> bool {
    exported(network) == Some("change")
}

/// What the outputs are of a file that 'nearl export' wrote: "actions", "change" or "state".
pub(super) fn exported(network: &ImportedNetwork) -> Option<&str> {
    network.metadata.contains_key("task").then_some(network.output_name.as_str())
}
