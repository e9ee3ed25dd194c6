//! Measures the thread CPU time of each stage for coupled rows, on problems that `benches/qp/gen.py` took from closed loops.
//!
//! `cargo bench -p nearl-constraints --bench qp -- FILE.bin...` prints percentiles; with `--out FOLDER` it also writes the time of each
//! problem, for `benches/qp/table.py` to set beside other solvers.

use nearl_constraints::{CoupledStages, Numbers};
use rustix::time::{ClockId, clock_gettime};
use std::path::{Path, PathBuf};

/// Passes over a file; each problem counts with the median of its passes.
const PASSES: usize = 11;

/// Problems of one file and their optima by quadprog.
struct Problems {
    name: String,
    all: Vec<Numbers>,
    optima: Vec<Vec<f64>>,
}

impl Problems {
    fn read(path: &Path) -> Problems {
        let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let word = |k: usize| <[u8; 8]>::try_from(&bytes[8 * k..8 * k + 8]).expect("eight bytes");
        let (n, count) = (u64::from_le_bytes(word(0)) as usize, u64::from_le_bytes(word(1)) as usize);
        let mut at = 2;
        let mut take = |len: usize| -> Vec<f64> {
            at += len;
            (at - len..at).map(|k| f64::from_le_bytes(word(k))).collect()
        };
        let (mut all, mut optima) = (vec![], vec![]);
        for _ in 0..count {
            let (goal, lower, upper, rows) = (take(n), take(n), take(n), take(n * n));
            let (row_lower, row_upper, soft, equality) = (take(n), take(n), vec![None; n], vec![false; n]);
            let hessian = vec![1.0; n];
            all.push(Numbers { hessian, goal, lower, upper, rows, row_lower, row_upper, soft, equality });
            optima.push(take(n));
        }
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Problems { name, all, optima }
    }
}

/// CPU time of this thread [ns].
fn now() -> i64 {
    let t = clock_gettime(ClockId::ThreadCPUTime);
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}

/// What reading the clock costs [ns].
fn clock() -> i64 {
    let mut each: Vec<i64> = (0..2001).map(|_| -now() + now()).collect();
    each.sort_unstable();
    each[1000]
}

/// What is timed.
#[derive(Clone, Copy, PartialEq)]
enum How {
    Warm,
    Cold,
    Clarabel,
}

struct Times {
    /// Median of the passes, per problem [us].
    each: Vec<f64>,
    iterations: Vec<u32>,
    failed: usize,
    furthest: f64,
}

fn time(problems: &Problems, how: How, passes: usize) -> Times {
    let (mut stages, clock) = (CoupledStages::new(&problems.all[0]).expect("a problem"), clock());
    let mut times = vec![Vec::with_capacity(passes); problems.all.len()];
    let (mut iterations, mut failed, mut furthest) = (vec![], 0, 0.0f64);
    for pass in 0..passes {
        for (k, numbers) in problems.all.iter().enumerate() {
            stages.put(numbers);
            if how == How::Cold {
                stages.forget();
            }
            let start = now();
            let solved = if how == How::Clarabel { stages.clarabel(1e-9) } else { stages.exact() };
            times[k].push(now() - start - clock);
            if pass + 1 == passes {
                let (y, steps) = match how {
                    How::Clarabel => (stages.clarabel_answer(), stages.clarabel_iterations()),
                    _ => (stages.exact_answer(), stages.exact_iterations()),
                };
                iterations.push(steps);
                failed += usize::from(!solved);
                let off = y.iter().zip(&problems.optima[k]).map(|(a, b)| (a - b).abs());
                furthest = off.fold(furthest, f64::max);
            }
        }
    }
    let median = |t: &mut Vec<i64>| {
        t.sort_unstable();
        t[t.len() / 2] as f64 / 1000.0
    };
    // The first problem has no tick before it.
    Times { each: times.iter_mut().skip(1).map(median).collect(), iterations, failed, furthest }
}

fn report(problems: &Problems, name: &str, times: &Times, out: Option<&Path>) {
    let mut sorted = times.each.clone();
    sorted.sort_by(f64::total_cmp);
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share) as usize];
    let mean = f64::from(times.iterations.iter().sum::<u32>()) / times.iterations.len() as f64;
    println!(
        "{:<8} {name:<16} p50 {:>7.2}  p99 {:>7.2}  p99.9 {:>7.2} us   steps {mean:>5.1}, most {:>3}   failed {}   error {:.1e}",
        problems.name,
        at(0.5),
        at(0.99),
        at(0.999),
        times.iterations.iter().max().unwrap_or(&0),
        times.failed,
        times.furthest
    );
    if let Some(folder) = out {
        let head = format!("# failed {} furthest {:e} steps {mean}\n", times.failed, times.furthest);
        let lines: String = times.each.iter().map(|t| format!("{t}\n")).collect();
        let path = folder.join(format!("{}.{name}.txt", problems.name));
        std::fs::write(&path, head + &lines).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    }
}

fn main() {
    let mut args: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    let out = args.iter().position(|a| a == "--out").map(|at| {
        args.remove(at);
        PathBuf::from(args.remove(at))
    });
    if args.is_empty() {
        println!("no problem files: benches/qp/run.sh makes them");
    }
    for file in &args {
        let problems = Problems::read(Path::new(file));
        for (name, how, passes) in [
            ("nearl", How::Warm, PASSES),
            ("nearl-cold", How::Cold, PASSES),
            ("clarabel-rust", How::Clarabel, 3),
        ] {
            report(&problems, name, &time(&problems, how, passes), out.as_deref());
        }
    }
}
