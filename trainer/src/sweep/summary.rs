//! What a sweep came to: the mean of the last ten rows of each run's metrics, and the interquartile mean of these over seeds. The report's table
//! has the last point of its curves instead.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use super::Run;

/// The end of one run: means over its last ten rows; numbers that it does not have are absent.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Row {
    /// Task.
    pub task: String,
    /// Algorithm.
    pub algo: String,
    /// Seed.
    pub seed: u64,
    /// Run folder.
    pub run: String,
    /// Environment steps.
    pub steps: Option<f64>,
    /// Mean over the last ten batches of the return in training, exploration on.
    #[serde(rename = "return")]
    pub return_mean: Option<f64>,
    /// The same of the cost.
    pub cost: Option<f64>,
    /// The same of the loss of the inverse model after an update.
    pub idm_loss: Option<f64>,
    /// Steps per second of one core, over the whole run.
    pub steps_per_s: Option<f64>,
}

/// One task and algorithm over its seeds: interquartile means, and the range of the return.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Task.
    pub task: String,
    /// Algorithm.
    pub algo: String,
    /// Runs with a return.
    pub seeds: usize,
    /// Fewest steps of a run.
    pub steps: Option<f64>,
    /// Return.
    #[serde(rename = "return")]
    pub return_mean: Option<f64>,
    /// Smallest return.
    pub lowest: Option<f64>,
    /// Largest return.
    pub highest: Option<f64>,
    /// Cost.
    pub cost: Option<f64>,
    /// Loss of the inverse model.
    pub idm_loss: Option<f64>,
    /// Steps per second of one core.
    pub steps_per_s: Option<f64>,
}

impl Row {
    /// Reads the end of a run.
    pub fn of(run: &Run) -> Row {
        let end = last_rows(&run.folder);
        let mean = |key: &str| {
            let values = end.get(key)?;
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        let last = |key: &str| end.get(key).and_then(|v| v.last().copied());
        Row {
            task: run.name.clone(),
            algo: run.algo.to_string(),
            seed: run.seed,
            run: run.folder.display().to_string(),
            steps: last("time/total_timesteps"),
            return_mean: mean("rollout/ep_rew_mean"),
            cost: mean("rollout/ep_cost_mean"),
            idm_loss: mean("idm/mse_after"),
            steps_per_s: last("time/fps"),
        }
    }
}

impl Summary {
    /// Groups rows by task and algorithm, in the order of the rows.
    pub fn of(rows: &[Row]) -> Vec<Summary> {
        let mut groups: Vec<(&str, &str)> = Vec::new();
        for row in rows {
            if !groups.contains(&(&row.task, &row.algo)) {
                groups.push((&row.task, &row.algo));
            }
        }
        let sum = |(task, algo): (&str, &str)| {
            let of = |f: fn(&Row) -> Option<f64>| -> Vec<f64> {
                let mut values: Vec<f64> =
                    rows.iter().filter(|r| r.task == task && r.algo == algo).filter_map(f).collect();
                values.sort_by(f64::total_cmp);
                values
            };
            let returns = of(|r| r.return_mean);
            Summary {
                task: task.into(),
                algo: algo.into(),
                seeds: returns.len(),
                steps: of(|r| r.steps).first().copied(),
                return_mean: interquartile_mean(&returns),
                lowest: returns.first().copied(),
                highest: returns.last().copied(),
                cost: interquartile_mean(&of(|r| r.cost)),
                idm_loss: interquartile_mean(&of(|r| r.idm_loss)),
                steps_per_s: interquartile_mean(&of(|r| r.steps_per_s)),
            }
        };
        groups.into_iter().map(sum).collect()
    }
}

/// Mean of the middle half of sorted values; values at its edges count in part.
fn interquartile_mean(sorted: &[f64]) -> Option<f64> {
    let n = sorted.len() as f64;
    if sorted.is_empty() {
        return None;
    }
    let (low, high) = (n / 4.0, 3.0 * n / 4.0);
    let weight = |i: usize| ((i + 1) as f64).min(high) - (i as f64).max(low);
    Some(sorted.iter().enumerate().map(|(i, x)| weight(i).max(0.0) * x).sum::<f64>() / (high - low))
}

/// The last ten numbers of each column, of lines that were written whole.
fn last_rows(folder: &Path) -> BTreeMap<String, Vec<f64>> {
    let text = std::fs::read_to_string(folder.join("metrics.csv")).unwrap_or_default();
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
    let rows: Vec<Vec<&str>> =
        lines.map(|l| l.split(',').collect()).filter(|r: &Vec<_>| r.len() == names.len()).collect();
    let column = |k: usize| {
        let numbers: Vec<f64> = rows.iter().filter_map(|r| r[k].parse().ok()).collect();
        numbers[numbers.len().saturating_sub(10)..].to_vec()
    };
    names.iter().enumerate().map(|(k, name)| ((*name).to_string(), column(k))).collect()
}

#[cfg(test)]
mod tests {
    use super::interquartile_mean;

    #[test]
    fn the_interquartile_mean_is_that_of_the_middle_half() {
        assert_eq!(interquartile_mean(&[]), None);
        assert_eq!(interquartile_mean(&[3.0]), Some(3.0));
        assert_eq!(interquartile_mean(&[1.0, 2.0]), Some(1.5));
        assert_eq!(interquartile_mean(&[-1e9, 1.0, 3.0, 1e9]), Some(2.0));
        // of three values each outer one counts a quarter: (0.25 * 0 + 1 * 3 + 0.25 * 12) / 1.5
        assert!((interquartile_mean(&[0.0, 3.0, 12.0]).unwrap_or(0.0) - 4.0).abs() < 1e-12);
    }
}
