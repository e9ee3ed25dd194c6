//! The table of `docs/FAULTS.md`: every fault of the design with the test that shows it.

use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Number, fault, what the runtime does, codes it gives, source file and name of the test.
type Row = (u32, &'static str, &'static str, &'static [&'static str], &'static str, &'static str);

const HERE: &str = "runtime/tests/faults/main.rs";
const FILES: &str = "runtime/tests/faults/files.rs";
const SYSTEM: &str = "runtime/tests/faults/system.rs";

/// All faults.
#[rustfmt::skip]
pub const ROWS: &[Row] = &[
    (1, "policy proposes NaN, infinity, 1e300", "brakes in the same tick, leaves the policy after 5 of them, counted", &["non-finite-proposals", "braked-non-finite-proposal"], HERE, "fault_01_odd_proposals_brake_and_are_counted"),
    (2, "measured state is NaN or infinite", "3 are bridged by prediction, then the plant brakes, after 8 latched", &["bad-state", "bad-states"], HERE, "fault_02_a_state_that_is_not_finite_is_bridged_then_braked_then_latched"),
    (3, "start outside limits", "only motion that returns, at limited speed", &["recovering"], HERE, "fault_03_a_start_outside_the_limits_only_returns"),
    (4, "first proposal far away", "the first motion is let in over 0.2 s, within every rate limit", &["active"], HERE, "fault_04_the_first_motion_is_let_in"),
    (5, "constraint set empty", "brakes as far as the motors can, counts what that breaks", &["no-certified-answers", "braked-no-certified-answer"], HERE, "fault_05_an_empty_set_brakes_and_names_the_status"),
    (6, "solver hits its iteration cap", "used only if the checker accepts, else brakes", &["braked-no-certified-answer"], HERE, "fault_06_an_answer_cut_by_the_iteration_cap_is_used_only_if_it_is_certified"),
    (7, "solver fails numerically", "brakes in that tick, the next is as if new", &["braked-non-finite-dynamics"], HERE, "fault_07_a_failed_solve_leaves_the_next_one_healthy"),
    (8, "controller or solver panics", "caught, discarded, latched; the robot model brakes", &["panic"], HERE, "fault_08_a_panic_is_latched_and_the_robot_model_brakes"),
    (9, "policy file of wrong shape, type, name", "refused, the loop keeps the last good one", &["snapshot-shape", "snapshot-missing-tensor", "foreign-shape"], "runtime/tests/panda.rs", "foreign_and_damaged_snapshots_are_refused_by_reason_while_the_loop_runs"),
    (10, "bit flips", "refused", &["snapshot-digest", "corrupt"], FILES, "fault_10_every_flipped_byte_is_refused"),
    (11, "NaN or huge weights, zero standard deviation", "refused", &["snapshot-value", "not-finite"], "tests/tests/processes.rs", "snapshots_that_do_not_fit_are_refused_with_their_reason_and_a_good_one_is_swapped_in"),
    (12, "truncated file", "refused at every length, the next good one is taken", &["snapshot-malformed"], FILES, "fault_12_every_truncation_is_refused"),
    (13, "file is a link, pipe, folder, device, unreadable", "refused at once without opening it", &["snapshot-unreadable"], FILES, "fault_13_what_is_no_regular_file_is_refused_at_once"),
    (14, "trainer killed while it publishes", "the loop goes on, nothing is torn, a new trainer attaches", &["accepted"], "runtime/tests/crash.rs", "a_trainer_killed_while_it_publishes_leaves_the_loop_running"),
    (15, "trainer stopped (SIGSTOP)", "the loop goes on, and swaps again when it is back", &["accepted"], SYSTEM, "fault_15_a_stopped_trainer_stops_nothing_else"),
    (16, "runtime killed", "the plant's watchdog brakes, a successor takes over", &["hold"], "runtime/tests/crash.rs", "a_killed_runtime_trips_the_watchdog_and_its_successor_takes_over"),
    (17, "restart storm", "the last one runs", &["active"], SYSTEM, "fault_17_a_storm_of_restarts_ends_with_a_runtime_that_runs"),
    (18, "consumer never reads", "the oldest are dropped and counted, the loop is unchanged", &["active"], SYSTEM, "fault_18_a_consumer_that_never_reads_loses_the_oldest_and_slows_nothing"),
    (19, "two runtimes of one name", "the second is refused", &["link-taken"], "runtime/tests/link.rs", "a_second_owner_is_refused_by_role"),
    (20, "shared memory tiny or read-only", "refused before any motion", &["link-memory", "link-memory-missing"], SYSTEM, "fault_20_shared_memory_that_is_tiny_or_read_only_is_refused_before_any_motion"),
    (21, "wall clock jumps", "no effect: it is never read", &["none"], SYSTEM, "fault_21_the_wall_clock_is_never_read"),
    (22, "one overrun", "counted, the slots are skipped", &["none"], HERE, "fault_22_one_overrun_is_counted_and_nothing_else"),
    (23, "overruns in a row", "after 3 degraded, after 10 braking, after 100 latched", &["overruns", "starved"], HERE, "fault_23_overruns_in_a_row_degrade_then_brake_then_latch"),
    (24, "stale sample: old time stamp, frozen values", "old: brakes; frozen: 3 bridged, then brakes", &["stale-state", "frozen-state"], HERE, "fault_24_stale_and_frozen_samples_brake"),
    (25, "dropped, doubled, reordered samples", "up to 3 lost are bridged by the plant, more brake; old ones are left out", &["lost-states"], HERE, "fault_25_lost_states_are_bridged_or_braked_and_others_left_out"),
    (26, "sensor jump", "rejected and counted, bridged 3 times, after 8 latched", &["implausible-state", "implausible-states"], HERE, "fault_26_a_jump_is_rejected_and_counted"),
    (27, "robot file with missing or odd limits", "refused, each joint listed", &["snapshot-unusable"], "constraints/tests/errors.rs", "limits_of_the_robot_file_that_are_not_there"),
    (28, "bad task file", "refused with file, line and key", &["snapshot-unusable"], "tests/tests/bad_input.rs", "a_bad_task_file_is_refused_with_file_line_and_key"),
    (29, "disk full while logging", "records are dropped and counted, the loop is unchanged", &["active"], "runtime/src/log/queue.rs", "a_full_disk_costs_records_and_nothing_else"),
    (30, "standard output closed", "ends quietly", &["none"], "tests/tests/bad_input.rs", "a_reader_that_closes_the_pipe_ends_the_program_quietly"),
    (31, "SIGINT, SIGTERM", "brakes to zero velocity, exit code 0", &["stop"], "runtime/tests/crash.rs", "sigterm_brakes_and_ends_with_success"),
    (32, "no right to priority, core or locked memory", "strict: refused; else warned", &["doctor-priority", "doctor-lock"], SYSTEM, "fault_32_a_refused_wish_is_an_error_if_strict_and_a_warning_if_not"),
    (33, "peer with wrong schema, lying lengths, NaN", "refused, counted, the loop keeps its mode", &["link-schema"], "runtime/tests/cycle.rs", "states_of_the_wrong_size_are_refused_and_counted"),
    (34, "Python holds its lock", "no effect: nothing the loop imports knows Python", &["none"], "tests/tests/architecture.rs", "no_other_arrow_exists"),
    (35, "opposite weights swapped in every 10 ms", "one version a tick, every limit holds", &["active"], HERE, "fault_35_opposite_policies_every_ten_ticks_obey_every_limit"),
    (36, "torque beyond the motors", "brakes; what is sent is within the motors' range", &["braked-no-certified-answer", "recovering"], HERE, "fault_36_torques_beyond_the_motors_are_never_sent"),
    (37, "denormal numbers", "no effect", &["none"], HERE, "fault_37_denormal_numbers_change_nothing"),
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn page() -> String {
    let mut page = String::from(
        "# Faults\n\nWhat may go wrong, what the runtime does, and the test that shows it. `nearl explain CODE` says what to do about a code.\n\
         Written by `NEARL_WRITE=1 cargo test --release -p nearl-runtime --test faults table`; a test fails when this page is old.\n\n\
         | # | fault | the runtime | codes | test |\n|---|---|---|---|---|\n",
    );
    for (number, fault, does, codes, file, test) in ROWS {
        let codes = codes.iter().map(|c| format!("`{c}`")).collect::<Vec<_>>().join(" ");
        writeln!(page, "| {number} | {fault} | {does} | {codes} | `{test}` in {file} |").unwrap();
    }
    page
}

#[test]
fn the_table_is_complete_and_its_tests_exist() {
    let numbers: Vec<u32> = ROWS.iter().map(|r| r.0).collect();
    assert_eq!(numbers, (1..=37).collect::<Vec<_>>());
    for (number, _, _, codes, file, test) in ROWS {
        let source = std::fs::read_to_string(root().join(file)).unwrap();
        let at = source.find(&format!("\n{}fn {test}()", if file.contains("/src/") { "    " } else { "" }));
        let at = at.unwrap_or_else(|| panic!("fault {number}: no test {test} in {file}"));
        assert!(source[..at].trim_end().ends_with(']'), "{test} is not a test");
        for code in *codes {
            nearl_runtime::codes::find(code).unwrap_or_else(|e| panic!("fault {number}: {e}"));
        }
    }
}

#[test]
fn the_page_is_current() {
    let file = root().join("docs/FAULTS.md");
    if std::env::var_os("NEARL_WRITE").is_some() {
        std::fs::write(&file, page()).unwrap();
    }
    let found = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(found == page(), "docs/FAULTS.md is old: run the command in its second line");
}
