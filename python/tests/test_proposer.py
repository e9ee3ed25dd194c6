"""Another process proposes in place of the policy: the robot goes where it is told, within its limits, and brakes when nobody says anything."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import nearl

CARRIAGE = """<robot name="carriage"><link name="rail"/><link name="carriage"><inertial><mass value="2"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="rail"/><child link="carriage"/><axis xyz="1 0 0"/>
<limit lower="-0.3" upper="0.4" velocity="0.8" effort="40"/></joint></robot>"""
TASK = """name = "carriage"
[model]
urdf = "carriage.urdf"
[time]
dt = 0.002
policy_every = 10
sim_dt = 0.002
[state]
observation = ["q.slide", "v.slide"]
[constraints]
position = { margin = 0.0 }
velocity = { scale = 1.0 }
acceleration = { limit = 15.0 }
torque = { scale = 1.0 }
[idm]
kind = "pinocchio"
"""
# A process of its own, which a test kills and stops: far beyond every limit, to and fro.
WILD = """
import sys, time
import nearl
with nearl.Proposer(sys.argv[1], patience=60.0) as proposer:
    for k, state in enumerate(proposer.states(patience=60.0)):
        side = 1.0 if k // 40 % 2 == 0 else -1.0
        proposer.propose([50.0 * side] * len(proposer.entries))
        time.sleep(0.002)
"""


def name(what: str) -> str:
    return f"py{os.getpid()}-{what}"


class Carriage:
    """2 kg on a rail, on a thread of its own."""

    def __init__(self, what: str) -> None:
        self.q, self.v, self.farthest, self.fastest = 0.0, 0.0, 0.0, 0.0
        self._over = threading.Event()
        self._plant = nearl.Plant(name(what), ["slide"], ["q.slide", "v.slide"], 0.002, 1, lockstep=True)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        time_, dt = 0.0, 0.002
        while not self._over.is_set():
            turn, action = self._plant.exchange([self.q], [self.v], [self.q, self.v], patience=0.05, time=time_)
            if turn == "brake" or action is None:
                self.v = 0.0
            else:
                self.v += dt * float(action[0]) / 2.0
                self.q += dt * self.v
            self.farthest, self.fastest = max(self.farthest, abs(self.q)), max(self.fastest, abs(self.v))
            time_ += dt
            time.sleep(0.0005)

    def __enter__(self) -> "Carriage":
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._plant.close()

    def obeys(self) -> None:
        assert 0.2 < self.farthest <= 0.4 + 1e-6 and 0.4 < self.fastest <= 0.8 + 1e-6, (self.farthest, self.fastest)


def blank(folder: Path, actions: bool = False) -> Path:
    (folder / "carriage.urdf").write_text(CARRIAGE)
    (folder / "carriage.toml").write_text(TASK)
    nearl.blank(str(folder / "carriage.toml"), folder / "blank.safetensors", actions=actions)
    return folder / "blank.safetensors"


def until(what: str, condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end, f"within 60 s: {what}"
        time.sleep(0.005)


def test_the_robot_goes_where_it_is_told_by_name(tmp_path: Path) -> None:
    with Carriage("told") as plant, nearl.Loop(blank(tmp_path), name("told"), ramp=0.0, proposal_age=5.0) as loop:
        with nearl.Proposer(name("told")) as proposer:
            assert (proposer.kind, proposer.entries) == ("states", ["q.slide", "v.slide"])
            assert (proposer.dt, proposer.policy_every, proposer.age_limit, proposer.hold) == (0.002, 10, 5.0, 0.1)
            with pytest.raises(ValueError, match="'v.slide' is missing"):
                proposer.propose({"q.slide": 0.1})
            with pytest.raises(ValueError, match="'elbow' is not asked for"):
                proposer.propose({"q.slide": 0.1, "v.slide": 0.0, "elbow": 1.0})
            for wrong, said in (
                ([0.1, float("nan")], r"values\[1\] \('v.slide'\) is nan; give a finite number, or propose nothing where there is none"),
                ({"v.slide": 0.0, "q.slide": float("-inf")}, r"values\[0\] \('q.slide'\) is -inf; give a finite number"),
                (["a", 0.0], r"values\[0\] \('q.slide'\) is 'a'; give a number"),
                ({"q.slide": 0.1, "v.slide": None}, r"values\[1\] \('v.slide'\) is None; give a number"),
                ([0.1], r"values has shape \(1,\), expected \(2,\)"),
            ):
                with pytest.raises(ValueError, match=said):
                    proposer.propose(wrong)
            with pytest.raises(ConnectionError, match="already has a proposer"):
                nearl.Proposer(name("told"), patience=0.1)
            state = proposer.state()
            assert state is not None and state.obs.tolist() == [*state.q, *state.v]

            def arrived() -> bool:
                state = proposer.state()
                assert state is not None
                proposer.propose({"q.slide": 0.25, "v.slide": 0.0})
                return abs(state.q[0] - 0.25) < 1e-3 and abs(state.v[0]) < 1e-3

            until("the carriage is at 0.25 m", arrived)
            until("the loop says so", lambda: proposer.account().taken > 0 and proposer.account().mode == "active")
        assert plant.fastest <= 0.8 + 1e-6
    assert loop.report is not None
    assert loop.report["counters"]["proposals"] > 0 and loop.report["proposer"]["answer"]["p50"] > 0
    with pytest.raises(ConnectionError, match="asks for proposals"):
        nearl.Proposer(name("told"), patience=0.1)


def test_a_snapshot_that_takes_other_proposals_is_refused(tmp_path: Path) -> None:
    """The proposer asked once what it is to give; it would have been refused from then on."""
    states = blank(tmp_path)
    taken = tmp_path / "states.safetensors"
    taken.write_bytes(states.read_bytes())
    with Carriage("other"), nearl.Loop(taken, name("other"), ramp=0.0, proposal_age=5.0), nearl.Link(name("other"), patience=20.0) as link:
        refused = link.push(blank(tmp_path, actions=True))
        assert not refused.accepted and "takes other proposals" in refused.text, refused
        assert link.push(taken).accepted


def test_actions_are_guarded(tmp_path: Path) -> None:
    with Carriage("acts") as plant, nearl.Loop(blank(tmp_path, actions=True), name("acts"), ramp=0.0, proposal_age=5.0) as loop:
        with nearl.Proposer(name("acts")) as proposer:
            assert (proposer.kind, proposer.entries) == ("actions", ["slide"])
            # 400 periods take it from one end to the other, also where the first of them pass before the loop hears the proposer.
            for k, _ in zip(range(20_000), proposer.states(), strict=False):
                proposer.propose([1e9 if k // 400 % 2 == 0 else -1e9])
                if k >= 600 and plant.farthest > 0.2 and plant.fastest > 0.4:
                    break
        plant.obeys()
    assert loop.report is not None and loop.report["counters"]["target_violations"] == 0


def test_a_proposer_killed_or_stopped_leads_to_a_brake_and_the_next_one_goes_on(tmp_path: Path) -> None:
    def wild() -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", WILD, name("wild")])

    with Carriage("wild") as plant, nearl.Loop(blank(tmp_path), name("wild"), ramp=0.0, proposal_age=0.3, proposal_hold=0.2) as loop:
        first = wild()
        with nearl.Link(name("wild"), patience=20.0) as link:
            until("it moves", lambda: plant.fastest > 0.4)
            os.kill(first.pid, signal.SIGSTOP)
            until("it brakes", lambda: str(link.states().mode[-1]) == "braking")
            os.kill(first.pid, signal.SIGCONT)
            until("it goes on", lambda: str(link.states().mode[-1]) == "active")
            first.kill()
            first.wait()
            until("it brakes again", lambda: str(link.states().mode[-1]) == "braking")
            second = wild()
            until("the next one takes over", lambda: str(link.states().mode[-1]) == "active")
            second.kill()
            second.wait()
    plant.obeys()
    assert loop.report is not None
    counters = loop.report["counters"]
    assert counters["held_proposals"] > 0 and counters["silent_proposer"] > 0 and counters["target_violations"] == 0


def test_what_cannot_be_blank_says_why(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="learned inverse model"):
        nearl.blank("HalfCheetah-v5", tmp_path / "none.safetensors")
    (tmp_path / "carriage.urdf").write_text(CARRIAGE)
    (tmp_path / "unseen.toml").write_text(TASK.replace('observation = ["q.slide", "v.slide"]', ""))
    with pytest.raises(ValueError, match="does not say what its plant observes"):
        nearl.blank(str(tmp_path / "unseen.toml"), tmp_path / "none.safetensors")
