//! The table of `docs/FAULTS.md`: every fault of the design with the test that shows it.

use std::fmt::Write;
use std::path::{Path, PathBuf};

/// A test: its source file and its name.
type Test = (&'static str, &'static str);
/// Number, fault, what the runtime does, codes it gives, and the tests.
type Row = (u32, &'static str, &'static str, &'static [&'static str], &'static [Test]);

const HERE: &str = "runtime/tests/faults/mod.rs";
const FILES: &str = "runtime/tests/faults/files.rs";
const LIMITS: &str = "runtime/tests/faults/limits.rs";
const SECURITY: &str = "runtime/tests/faults/security.rs";
const KILLS: &str = "runtime/tests/faults/kills.rs";
const PEERS: &str = "runtime/tests/faults/peers.rs";
const SOLVER: &str = "runtime/tests/faults/solver.rs";
const SPOILT: &str = "constraints/src/projector/spoilt.rs";
const PROCESSES: &str = "tests/tests/programs/processes.rs";
const PROPOSERS: &str = "runtime/tests/faults/proposers.rs";
const CLOCK: &str = "runtime/tests/clock.rs";
const INPUT: &str = "tests/tests/programs/bad_input.rs";
const GIL: &str = "python/tests/test_gil.py";
const BOMBS: &str = "tests/tests/programs/bombs.rs";
const FRICTION: &str = "tests/tests/suite/friction.rs";
const SIMULATOR: &str = "tests/tests/suite/limits_in_simulator.rs";
const OPERATOR: &str = "runtime/tests/suite/limits.rs";
const MOVING: &str = "constraints/tests/suite/moving/joints.rs";
const SYSTEM: &str = "runtime/tests/faults/system.rs";

/// All faults.
pub const ROWS: &[Row] = &[
    (
        1,
        "policy proposes NaN, infinity, 1e300",
        "brakes in the same tick, leaves the policy after 5 of them, counted",
        &["braked-non-finite-proposal"],
        &[(HERE, "fault_01_odd_proposals_brake_and_are_counted")],
    ),
    (
        2,
        "measured state is NaN or infinite",
        "3 are bridged by prediction, then the plant brakes, after 8 latched until the run is ended, with exit code 6",
        &["bad-state", "bad-states"],
        &[(HERE, "fault_02_a_state_that_is_not_finite_is_bridged_then_braked_then_latched")],
    ),
    (
        3,
        "start outside limits",
        "only motion that returns, at limited speed",
        &["recovering"],
        &[(HERE, "fault_03_a_start_outside_the_limits_only_returns")],
    ),
    (
        4,
        "first proposal far away",
        "the first motion is let in over 0.2 s, within every rate limit",
        &["active"],
        &[(HERE, "fault_04_the_first_motion_is_let_in")],
    ),
    (
        5,
        "constraint set empty",
        "soft rows give way and are named; hard ones: brakes as far as the motors can",
        &["braked-no-certified-answer"],
        &[(SOLVER, "fault_05_contradicting_soft_rows_give_way_by_name_and_hard_ones_brake")],
    ),
    (
        6,
        "solver hits its iteration cap or deadline",
        "used only if the checker accepts, else brakes",
        &["braked-no-certified-answer"],
        &[(SOLVER, "fault_06_an_answer_cut_by_cap_or_deadline_is_used_only_if_the_checker_accepts")],
    ),
    (
        7,
        "solver fails numerically",
        "brakes in that tick, the next is as if new",
        &["braked-non-finite-dynamics"],
        &[
            (SOLVER, "fault_07_a_failed_solve_leaves_the_next_one_healthy"),
            (SPOILT, "fault_07_a_nan_in_p_brakes_in_its_tick_and_the_next_is_as_if_new"),
        ],
    ),
    (
        8,
        "controller or solver panics",
        "caught, discarded, latched; the robot model brakes",
        &["panic"],
        &[(HERE, "fault_08_a_panic_is_latched_and_the_robot_model_brakes")],
    ),
    (
        9,
        "policy file of wrong shape, type, name",
        "refused, the loop keeps the last good one",
        &["snapshot-shape", "snapshot-missing-tensor"],
        &[(FILES, "fault_09_every_tensor_that_is_missing_or_of_another_type_or_shape_is_refused_by_name")],
    ),
    (
        10,
        "bit flips",
        "refused",
        &["snapshot-digest", "corrupt"],
        &[(FILES, "fault_10_every_flipped_byte_is_refused")],
    ),
    (
        11,
        "NaN or huge weights, zero standard deviation",
        "refused",
        &["snapshot-value", "not-finite"],
        &[(FILES, "fault_11_every_number_that_is_none_or_far_too_large_is_refused_with_its_place")],
    ),
    (
        12,
        "truncated file",
        "refused at every length, the next good one is taken",
        &["snapshot-malformed"],
        &[(FILES, "fault_12_every_truncation_is_refused")],
    ),
    (
        13,
        "file is a link, pipe, folder, device, unreadable",
        "refused at once without opening it",
        &["snapshot-unreadable"],
        &[(FILES, "fault_13_what_is_no_regular_file_is_refused_at_once")],
    ),
    (
        14,
        "trainer killed while it publishes",
        "the loop goes on, nothing is torn, a new trainer attaches",
        &["accepted"],
        &[(KILLS, "fault_14_a_trainer_killed_while_it_publishes_tears_nothing")],
    ),
    (
        15,
        "trainer stopped (SIGSTOP)",
        "the loop goes on, says after `--snapshot-age` that none came, and swaps again when it is back",
        &["accepted"],
        &[(SYSTEM, "fault_15_a_stopped_trainer_stops_nothing_else")],
    ),
    (
        16,
        "runtime killed",
        "the plant's watchdog brakes within its time, a successor takes over from Hold",
        &["hold"],
        &[(KILLS, "fault_16_a_killed_runtime_is_braked_in_time_and_its_successor_takes_over")],
    ),
    (
        17,
        "restart storm",
        "each start removes what others left, with back-off; the last one runs",
        &["active"],
        &[
            (KILLS, "fault_17_a_storm_of_restarts_ends_with_a_runtime_that_runs"),
            (KILLS, "fault_43_a_start_killed_by_a_preloaded_library_stands_in_the_way_of_none_after_it"),
        ],
    ),
    (
        18,
        "consumer never reads",
        "the oldest are dropped and counted, the loop is unchanged",
        &["active"],
        &[(SYSTEM, "fault_18_what_a_consumer_never_reads_takes_no_more_memory")],
    ),
    (
        19,
        "two runtimes of one name",
        "the second is refused",
        &["link-taken"],
        &[(PROCESSES, "a_second_plant_or_runtime_of_the_same_name_is_refused")],
    ),
    (
        20,
        "shared memory tiny or read-only",
        "refused before any motion",
        &["link-memory", "link-memory-missing"],
        &[(SYSTEM, "fault_20_shared_memory_that_is_tiny_or_read_only_is_refused_before_any_motion")],
    ),
    (
        21,
        "wall clock jumps",
        "no effect: it is never read",
        &["none"],
        &[(CLOCK, "fault_21_a_wall_clock_that_jumps_changes_no_bit")],
    ),
    (
        22,
        "one overrun",
        "counted, the slots are skipped",
        &["none"],
        &[(HERE, "fault_22_one_overrun_is_counted_and_nothing_else")],
    ),
    (
        23,
        "overruns in a row",
        "after 3 degraded, after 10 braking, after 100 (a tenth of a second at high rates) latched",
        &["overruns", "starved"],
        &[(HERE, "fault_23_overruns_in_a_row_degrade_then_brake_then_latch")],
    ),
    (
        24,
        "stale sample: old time stamp, frozen values, a clock of the plant that stands or runs backwards",
        "old: brakes; the others: 3 bridged, then brakes",
        &["stale-state", "frozen-state"],
        &[(HERE, "fault_24_stale_and_frozen_samples_brake")],
    ),
    (
        25,
        "dropped, doubled, reordered, left-out samples",
        "up to 3 lost are bridged by the plant, more brake; old ones are left out",
        &["lost-states"],
        &[
            (HERE, "fault_25_lost_states_are_bridged_or_braked_and_others_left_out"),
            (HERE, "fault_25_periods_that_the_plant_left_out_are_lost_ones"),
        ],
    ),
    (
        26,
        "sensor jump",
        "rejected, bridged 3 times, after 8 latched; nothing sent where an episode begins with one, or with velocities of another motion",
        &["implausible-state", "implausible-states", "wrong-velocity"],
        &[
            (HERE, "fault_26_a_jump_is_rejected_and_counted"),
            (HERE, "fault_26_velocities_of_another_motion_end_the_loop"),
        ],
    ),
    (
        27,
        "robot file with missing or odd limits",
        "refused, each joint listed",
        &["snapshot-unusable"],
        &[(FILES, "fault_27_missing_and_odd_limits_are_refused_by_joint")],
    ),
    (
        28,
        "bad task file",
        "refused with file, line and key",
        &["snapshot-unusable"],
        &[(INPUT, "a_bad_task_file_is_refused_with_file_line_and_key")],
    ),
    (
        29,
        "disk full while logging",
        "records are dropped and counted, the loop is unchanged",
        &["active"],
        &[(SYSTEM, "fault_29_a_disk_that_fills_up_costs_records_and_no_tick")],
    ),
    (
        30,
        "standard output or log reader closed",
        "the loop runs on; commands end quietly",
        &["none"],
        &[(PROCESSES, "a_run_whose_readers_are_gone_moves_on_and_ends_well")],
    ),
    (
        31,
        "SIGINT, SIGTERM, SIGHUP",
        "brakes to zero velocity, exit code 0; a second one, after 0.2 s or later, ends at once with 130",
        &["stop"],
        &[(KILLS, "fault_31_a_signal_at_any_moment_brakes_to_rest_and_a_second_one_ends_at_once")],
    ),
    (
        32,
        "no right to priority, core or locked memory",
        "strict: refused; else warned",
        &["doctor-priority", "doctor-lock"],
        &[(SYSTEM, "fault_32_without_rights_strict_refuses_and_best_effort_warns")],
    ),
    (
        33,
        "peer with wrong schema, lying lengths, NaN, old version, flood; random words in boards",
        "refused, counted, the loop keeps its mode",
        &["corrupt", "not-finite", "outdated", "superseded"],
        &[
            (PEERS, "fault_33_a_peer_with_lies_and_a_flood_is_refused_and_counted"),
            (PEERS, "fault_33_lies_on_every_topic_end_nothing_and_move_nothing"),
            (PEERS, "fault_33_random_words_in_live_boards_end_nothing"),
        ],
    ),
    (
        34,
        "Python holds its lock for a second",
        "no effect: the loop is another process and knows no Python",
        &["none"],
        &[
            (GIL, "test_the_loop_runs_on_while_python_holds_its_lock"),
            (GIL, "test_a_loop_that_waits_for_the_lock_in_one_tick_of_many_is_found"),
        ],
    ),
    (
        35,
        "opposite weights swapped in every 10 ms",
        "one version a tick, every limit holds",
        &["active"],
        &[(HERE, "fault_35_opposite_policies_every_ten_ticks_obey_every_limit")],
    ),
    (
        36,
        "torque beyond the motors: speed, payload, singular inertia",
        "brakes; what is sent is within the motors' range",
        &["braked-no-certified-answer"],
        &[
            (SOLVER, "fault_36_a_wrong_payload_and_a_singular_inertia_brake"),
            (SPOILT, "fault_36_what_rows_of_a_wrong_robot_let_through_the_checker_rejects"),
        ],
    ),
    (
        37,
        "denormal numbers",
        "no effect: the same work in every tick",
        &["none"],
        &[(SOLVER, "fault_37_denormal_numbers_change_nothing")],
    ),
    (
        38,
        "pushed snapshot with looser limits, another robot, or a policy that projects nothing",
        "refused by joint and number; a tighter one is taken",
        &["looser-limits"],
        &[(LIMITS, "fault_38_a_pushed_snapshot_may_tighten_the_limits_but_never_loosen_them")],
    ),
    (
        39,
        "deep, long or huge snapshot, robot, task, expression, line, MJCF",
        "refused by name within bounded memory and time, no stack overflows; the loop runs on",
        &["snapshot-foreign", "corrupt"],
        &[
            (FILES, "fault_39_a_manifest_nested_beyond_measure_is_refused_and_overflows_no_stack"),
            (BOMBS, "robots_that_ask_for_too_much_are_refused_by_element_and_number"),
            (BOMBS, "tasks_that_take_too_much_to_read_are_refused_by_key_and_number"),
            (BOMBS, "task_files_beyond_their_size_are_refused_by_name_before_they_are_parsed"),
            (BOMBS, "lines_and_lists_without_an_end_are_refused_by_their_number"),
        ],
    ),
    (
        40,
        "pipe, device, folder, link, endless file at a path that is opened; long TMPDIR",
        "refused at once, by name",
        &["link-foreign", "snapshot-unreadable"],
        &[
            (SECURITY, "fault_40_what_is_no_file_is_refused_at_once_at_every_path_that_is_opened"),
            (BOMBS, "pipes_and_endless_files_are_refused_at_once_by_every_command"),
        ],
    ),
    (
        41,
        "another user made the files first, or opens ours",
        "refused by name, owner and mode; nothing of ours can be opened",
        &["link-foreign"],
        &[
            (
                SECURITY,
                "fault_41_another_user_can_open_nothing_and_what_another_user_made_is_refused_by_name",
            ),
            (SECURITY, "fault_41_what_another_user_made_is_in_no_list_and_stays"),
        ],
    ),
    (
        42,
        "mapped file made shorter while in use",
        "plant and loop brake and end by name",
        &["memory-torn"],
        &[
            (SECURITY, "fault_42_files_truncated_in_use_brake_the_plant_and_end_both_by_name"),
            (SECURITY, "fault_42_a_driver_whose_files_are_truncated_is_told_to_brake"),
        ],
    ),
    (
        43,
        "kill at any system call of a start",
        "the next start begins anew, alone or beside a survivor",
        &["doctor-links"],
        &[(KILLS, "fault_43_a_start_killed_at_any_system_call_stands_in_the_way_of_none_after_it")],
    ),
    (
        44,
        "log file exists",
        "a new name; never written over",
        &["active"],
        &[(LIMITS, "fault_44_a_log_that_is_there_is_never_written_over")],
    ),
    (
        45,
        "plant or loop gone; plant slower than the wall",
        "the other side ends by name with its own exit code; the wall's time counts",
        &["plant-gone", "loop-gone"],
        &[(LIMITS, "fault_45_a_plant_or_a_loop_that_is_gone_ends_the_other_with_its_own_code")],
    ),
    (
        46,
        "motors too weak to hold the arm within its limits",
        "doctor and run refuse, by joint, needed and available force",
        &["doctor-holding"],
        &[(LIMITS, "fault_46_motors_too_weak_to_hold_the_arm_are_refused_by_joint_and_number")],
    ),
    (
        47,
        "dry friction, dampers and springs of the plant",
        "made up for in actions and brakes; how far others may be off is said",
        &["doctor-model"],
        &[
            (FRICTION, "a_joint_that_rubs_keeps_its_limits_under_attack"),
            (FRICTION, "a_task_whose_robot_rubs_keeps_its_limits_in_the_simulator"),
            (FRICTION, "what_friction_may_do_is_said_by_joint_and_number"),
            (SIMULATOR, "a_robot_with_dampers_and_springs_keeps_its_limits"),
        ],
    ),
    (
        48,
        "a plant that moves otherwise than told: sub-steps, jitter, another period",
        "torque exact, speed and position to half a period; another period: brakes",
        &["wrong-period"],
        &[
            (HERE, "fault_48_a_plant_that_moves_otherwise_than_told_keeps_torque_and_nearly_the_rest"),
            (HERE, "fault_48_a_plant_with_another_period_than_told_brakes_until_it_keeps_it"),
        ],
    ),
    (
        49,
        "proposer killed, stopped, slow, or proposing nonsense",
        "its last proposal is held, then brakes; a successor is taken up; nonsense is refused",
        &["silent-proposer"],
        &[(
            PROPOSERS,
            "fault_49_a_proposer_killed_or_stopped_is_held_then_braked_and_its_successor_taken_up",
        )],
    ),
    (
        50,
        "limits tightened in motion below the present state",
        "the declared way to them, never a loosening",
        &["tightening"],
        &[
            (OPERATOR, "an_operator_moves_the_limits_of_a_running_loop"),
            (MOVING, "joints_with_torque_keep_what_is_declared_on_the_way_to_moved_limits"),
        ],
    ),
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn page() -> String {
    let mut page = String::from(
        "# Faults\n\nWhat may go wrong, what the runtime does, and the test that shows it. `nearl explain CODE` says what to do about a code.\n\
         Written by `NEARL_WRITE=1 cargo test --release -p nearl-runtime --test suite faults::table`; a test fails when this page is old.\n\n\
         | # | fault | the runtime |\n|---|---|---|\n",
    );
    for (number, fault, does, ..) in ROWS {
        writeln!(page, "| {number} | {fault} | {does} |").unwrap();
    }
    page += "\n## Codes and tests\n";
    let mut files: Vec<&str> = ROWS.iter().flat_map(|row| row.4).map(|test| test.0).collect();
    files.sort_unstable();
    files.dedup();
    for file in files {
        writeln!(page, "\n[{file}](../{file}):\n").unwrap();
        for (number, _, _, codes, tests) in ROWS {
            let codes = codes.iter().map(|c| format!("`{c}`")).collect::<Vec<_>>().join(" ");
            for (_, test) in tests.iter().filter(|test| test.0 == file) {
                writeln!(page, "- {number}: {codes}\n  `{test}`").unwrap();
            }
        }
    }
    page
}

#[test]
fn the_table_is_complete_and_its_tests_exist() {
    let numbers: Vec<u32> = ROWS.iter().map(|r| r.0).collect();
    assert_eq!(numbers, (1..=50).collect::<Vec<_>>());
    for (number, _, _, codes, tests) in ROWS {
        assert!(!tests.is_empty(), "fault {number} has no test");
        for (file, test) in *tests {
            let source = std::fs::read_to_string(root().join(file)).unwrap();
            let is_python = file.ends_with(".py");
            let at = source.find(&format!("{} {test}(", if is_python { "def" } else { "fn" }));
            let at = at.unwrap_or_else(|| panic!("fault {number}: no test {test} in {file}"));
            assert!(is_python || source[..at].trim_end().ends_with(']'), "{test} is not a test");
        }
        for code in *codes {
            nearl_runtime::codes::find(&nearl_runtime::codes::all(), code)
                .unwrap_or_else(|e| panic!("fault {number}: {e}"));
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
