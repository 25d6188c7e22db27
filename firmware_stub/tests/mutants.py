"""Mutation tests of the safety rules: each mutant breaks one rule in the source; the unit tests must notice.

A mutant is one line of source changed.  It survives if the tests still pass, and then this script fails:
a rule nobody tests is a rule nobody keeps.  `make mutants`, or python tests/mutants.py --build DIRECTORY.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FLAGS = ["-std=c11", "-O0", "-ffp-contract=off", "-Iinclude", "-Icodec", "-Iports/memory", "-Itests"]
TIMEOUT = 60.0

# (source, what stands there, what the mutant says, the rule it breaks)
MUTANTS = [
    # end-to-end check
    ("e2e", "return payload[0] == ipmsm_e2e_crc8(payload, 8, data_id);", "return true;", "CRC is checked"),
    ("e2e", "return payload[0] == ipmsm_e2e_crc8(payload, 8, data_id);",
     "return payload[0] == ipmsm_e2e_crc8(payload, 7, data_id);", "CRC covers the last byte"),
    ("e2e", "crc = crc8_table[crc ^ data_id];", "", "CRC covers the data identifier"),
    ("e2e", "data_ids[payload[1] & 0x0Fu] + node", "data_ids[payload[1] & 0x0Fu]", "CRC tells nodes apart"),
    ("e2e", "data_ids[payload[1] & 0x0Fu] + node", "data_ids[0] + node", "CRC depends on the counter"),
    ("e2e", "(uint8_t)(crc ^ 0xFFu)", "crc", "CRC is inverted at the end"),
    ("e2e", "0x00u, 0x2Fu, 0x5Eu", "0x00u, 0x2Eu, 0x5Eu", "CRC table"),
    ("e2e", "!sequence->seen || step == 1u", "step == 1u", "first frame is taken"),
    ("e2e", "!sequence->seen || step == 1u", "step <= 1u", "repeated frame is refused"),
    ("e2e", "step <= largest_step", "step <= largest_step + 1u", "old frame is refused"),
    ("e2e", "step <= largest_step", "true", "any jump is refused"),
    ("e2e", "step <= largest_step", "step < largest_step", "loss up to the limit is taken"),
    ("e2e", "sequence->last = counter;", "if (status <= IPMSM_E2E_SOME_LOST) { sequence->last = counter; }",
     "restarted sender is heard again"),
    ("e2e", "sequence->lost += (uint32_t)step - 1u;", "sequence->lost += (uint32_t)step;",
     "lost frames are counted"),
    # what is taken from the bus
    ("receiver", "if (ipmsm_e2e_intact(payload, data_ids, node))", "if (true)", "wrong CRC is refused"),
    ("receiver", "status = ipmsm_e2e_follow(&stream->sequence, payload[1] & 0x0Fu, IPMSM_FRAMES_MISSED);",
     "status = IPMSM_E2E_OK;", "counter is checked"),
    ("receiver", "return status <= IPMSM_E2E_SOME_LOST;", "return status <= IPMSM_E2E_REPEATED;",
     "frozen counter"),
    ("receiver", "return status <= IPMSM_E2E_SOME_LOST;", "return status <= IPMSM_E2E_WRONG_SEQUENCE;",
     "old counter"),
    ("receiver", "return status <= IPMSM_E2E_SOME_LOST;", "return status <= IPMSM_E2E_WRONG_CRC;", "wrong CRC"),
    ("receiver", "return status <= IPMSM_E2E_SOME_LOST;", "return status == IPMSM_E2E_OK;", "loss is no error"),
    ("receiver", "stream->counts[status]++;", "", "verdicts are counted"),
    ("receiver", "is_good(&receiver->commands, payload, command_ids, receiver->node)",
     "is_good(&receiver->estimates, payload, command_ids, receiver->node)", "streams are apart"),
    ("receiver", "is_good(&receiver->commands, payload, command_ids, receiver->node)",
     "is_good(&receiver->commands, payload, estimate_ids, receiver->node)", "identifiers are apart"),
    ("receiver", "frame->length != BYTES || ", "", "wrong length is no frame of ours"),
    ("receiver", "(IPMSM_FRAME_EXTENDED | IPMSM_FRAME_REMOTE)", "IPMSM_FRAME_REMOTE", "extended identifier"),
    ("receiver", "(IPMSM_FRAME_EXTENDED | IPMSM_FRAME_REMOTE)", "IPMSM_FRAME_EXTENDED", "remote frame"),
    ("receiver", "IPMSM_CAN_INJECTION_COMMAND_FRAME_ID + receiver->node", "IPMSM_CAN_INJECTION_COMMAND_FRAME_ID",
     "command of another node"),
    # how old an angle may grow
    ("receiver", "receiver->warm_up > 0u || age > receiver->max_age", "age > receiver->max_age",
     "last run's samples"),
    ("receiver", "receiver->warm_up > 0u || age > receiver->max_age", "receiver->warm_up > 0u", "late estimate"),
    ("receiver", "receiver->warm_up > 0u || age > receiver->max_age",
     "receiver->warm_up > 0u || age > receiver->max_age + 1u", "late estimate, to the sample"),
    ("receiver", "receiver->late++;", "", "late estimates are counted"),
    ("receiver", "return estimate->held && sample", "return sample", "nothing before the first estimate"),
    ("receiver", "sample - estimate->sample <= receiver->max_age", "true", "stale by samples"),
    ("receiver", "sample - estimate->sample <= receiver->max_age",
     "sample - estimate->sample <= receiver->max_age + 1u", "stale by samples, to the sample"),
    ("receiver", "now_us - estimate->arrived_us <= receiver->max_age_us", "true", "stale by the clock"),
    ("receiver", "now_us - estimate->arrived_us <= receiver->max_age_us",
     "now_us - estimate->arrived_us <= receiver->max_age_us + 1u", "stale by the clock, to the microsecond"),
    ("receiver", "now_us - estimate->arrived_us <= receiver->max_age_us",
     "now_us <= estimate->arrived_us + receiver->max_age_us", "the clock wraps"),
    ("receiver", "receiver->estimate.held = is_fresh(receiver, sample, now_us);", "", "stale stays stale"),
    ("receiver", "samples < (float)(SAMPLE_MASK + 1u)", "true", "ten bits of counter must do"),
    # whether an angle may be used
    ("receiver", "if (!is_fresh(receiver, sample, now_us)) {\n        return IPMSM_ANGLE_MISSING;\n    }", "",
     "stale angle is refused"),
    ("receiver", "return estimate->valid ? IPMSM_ANGLE_USABLE", "return true ? IPMSM_ANGLE_USABLE", "valid"),
    ("receiver", "(estimate->valid || certain)", "true", "neither valid nor certain"),
    ("receiver", "(estimate->valid || certain)", "estimate->valid", "a control may go on"),
    ("receiver", "estimate->locked && estimate->polarity_known", "estimate->polarity_known", "locked"),
    ("receiver", "estimate->locked && estimate->polarity_known", "estimate->locked", "polarity"),
    ("receiver", "estimate->sigma_known && ", "", "unknown uncertainty"),
    ("receiver", "estimate->sigma_theta <= receiver->sigma_limit", "true", "uncertainty"),
    ("receiver", "estimate->sigma_theta <= receiver->sigma_limit",
     "estimate->sigma_theta <= receiver->sigma_limit + 0.5f", "uncertainty, to the step"),
    ("receiver", "(float)(sample - estimate->sample) + ahead", "ahead", "angle is extrapolated"),
    # what is executed
    ("probing", "command->waveform > IPMSM_WAVEFORM_POLARITY_PULSES", "false", "unknown waveform"),
    ("probing", "command->time_to_live <= LONGEST_COMMAND", "true", "absurd time to live"),
    ("probing", "if (!(command->amplitude >= 0.0f))", "if (command->amplitude < 0.0f)", "amplitude NaN"),
    ("probing", "command->frequency <= half_rate", "true", "frequency above half the sample rate"),
    ("probing", "command->frequency >= LOWEST_FREQUENCY && ", "", "frequency 0"),
    ("probing", "probing->samples_left == 0u || ", "", "stale by samples"),
    ("probing", " || now_us - probing->asked_us > probing->time_to_live_us", "", "stale by the clock"),
    ("probing", "now_us - probing->asked_us > probing->time_to_live_us",
     "now_us > probing->asked_us + probing->time_to_live_us", "the clock wraps"),
    ("probing", "now_us - probing->asked_us > probing->time_to_live_us",
     "now_us - probing->asked_us > probing->time_to_live_us + 1u", "stale by the clock, to the microsecond"),
    ("probing", "probing->samples_left--;", "", "time to live runs"),
    ("probing", "* probing->samples_in_ms + 0.01f)", "* probing->samples_in_ms + 1.0f)", "not a sample longer"),
    ("probing", "probing->asked_us = now_us;", "", "time to live counts from arrival"),
    ("probing", "        ipmsm_probing_stop(probing);\n        return;", "        return;", "stale ends for good"),
    ("probing", "    probing->samples_left = 0;\n", "", "stop drops the command"),
    ("probing", "    probing->amplitude = 0.0f;\n}", "}", "stop takes the amplitude away"),
    ("probing", "if (target > probing->limit) {", "if (false) {", "clamp: the drive's own limit"),
    ("probing", "if (target > IPMSM_PROBING_LIMIT) {", "if (false) {", "clamp: compile-time limit"),
    ("probing", "target = IPMSM_PROBING_LIMIT;", "target = 2.0f * IPMSM_PROBING_LIMIT;", "clamp: to that limit"),
    ("probing", "amplitude = (amplitude < target) ? amplitude : target;", "", "ramp ends at the target"),
    ("probing", "amplitude += change;", "amplitude = target;", "amplitude is ramped"),
    ("probing", "if (amplitude <= RAMP_END * change) {", "if (true) {", "another waveform waits for the ramp"),
    ("probing", "return quotient + (uint32_t)correction;", "return quotient;", "the phase keeps its frequency"),
    # the drive
    ("drive", "received == IPMSM_RECEIVED_BAD_COMMAND", "false", "refused commands are counted"),
    ("drive", "&& !ipmsm_probing_ask(&drive->probing, &command, now)",
     "&& !(ipmsm_probing_ask(&drive->probing, &command, now) || true)", "commands not executable are counted"),
    ("drive", "drive->rejected_now = true;", "", "a refusal shows in the faults"),
    ("drive", "if (verdict == IPMSM_ANGLE_USABLE || verdict == IPMSM_ANGLE_DOUBTFUL) {", "if (true) {",
     "no angle where none may be used"),
    ("drive", "if (verdict == IPMSM_ANGLE_USABLE || verdict == IPMSM_ANGLE_DOUBTFUL) {",
     "if (verdict == IPMSM_ANGLE_USABLE) {", "an angle to go on with"),
    ("drive", "ipmsm_receiver_expire(&drive->receiver, latest_sample(drive), now_us(drive));", "",
     "ageing goes on"),
    ("drive", "n < IPMSM_RECEIVE_AT_ONCE", "n < 1000u", "a flood cannot hold the interrupt"),
    ("drive", "        if (taken) {\n            ipmsm_sender_sent(&drive->sender);\n        }",
     "        ipmsm_sender_sent(&drive->sender);", "timing names a sample that was sent"),
    ("sender", "sender->crc = ipmsm_e2e_crc16(sender->crc, first, BLOCK_SAMPLE);",
     "sender->crc = ipmsm_e2e_crc16(sender->crc, first, BLOCK_SAMPLE - 1u);", "CRC covers every sample"),
    ("sender", "data[2] = sender->block_counter++;", "data[2] = sender->block_counter;", "blocks are counted"),
]


def compile_command(source: Path, target: Path) -> list[str]:
    return ["gcc", *FLAGS, "-c", str(source), "-o", str(target)]


def run_mutant(build: Path, number: int) -> str:
    """killed, survived, or what went wrong with making the mutant."""
    name, old, new, _ = MUTANTS[number]
    text = (ROOT / "src" / f"{name}.c").read_text("utf-8")
    if text.count(old) != 1:
        return f"{text.count(old)} places in {name}.c instead of 1"
    source, mutated, program = (build / f"m{number}{end}" for end in (".c", ".o", ""))
    source.write_text(text.replace(old, new), "utf-8")
    made = subprocess.run(compile_command(source, mutated), cwd=ROOT, capture_output=True, text=True)
    if made.returncode:
        return "does not compile: " + (made.stderr.strip().splitlines() or ["no message"])[0]
    others = [str(o) for o in sorted((build / "objects").glob("*.o")) if o.name != f"{name}.o"]
    subprocess.run(["gcc", str(mutated), *others, "-lm", "-o", str(program)], cwd=ROOT, check=True)
    try:
        tested = subprocess.run([str(program)], capture_output=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return "killed"
    return "killed" if tested.returncode else "survived"


def main() -> int:
    parser = argparse.ArgumentParser(description="mutation tests of the safety rules")
    parser.add_argument("--build", type=Path, required=True, help="directory for what is compiled; emptied first")
    build = parser.parse_args().build.resolve()
    shutil.rmtree(build, ignore_errors=True)
    (build / "objects").mkdir(parents=True)
    sources = [*(ROOT / "src").glob("*.c"), *(ROOT / "tests").glob("*.c"), ROOT / "codec" / "ipmsm_can.c",
               ROOT / "ports" / "memory" / "memory_port.c"]
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        list(pool.map(lambda s: subprocess.run(
            compile_command(s, build / "objects" / f"{s.stem}.o"), cwd=ROOT, check=True), sources))
        objects = sorted(str(o) for o in (build / "objects").glob("*.o"))
        subprocess.run(["gcc", *objects, "-lm", "-o", str(build / "whole")], check=True)
        if subprocess.run([str(build / "whole")], capture_output=True, timeout=TIMEOUT).returncode:
            print("mutants: the unit tests fail without any mutant", file=sys.stderr)
            return 1
        results = list(pool.map(lambda n: run_mutant(build, n), range(len(MUTANTS))))
    left = 0
    for (name, _, new, rule), result in zip(MUTANTS, results, strict=True):
        if result != "killed":
            left += 1
            print(f"mutants: {name}.c, {rule}: {result}: {new!r}")
    print(f"{len(MUTANTS)} mutants, {len(MUTANTS) - left} killed")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
