"""Time stamps: parsed from messages, and held against the times of logging, for the truth, lists of units and poses.

A stamp that is not set (0, no number, of another clock than its neighbours') is replaced by the time of logging, by the
clock of the other stamps. A stamp that falls while log time rises begins a new run: two runs are never one log.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from pathlib import Path

import numpy as np

from copem_replay.core.errors import RecordingError
from copem_replay.core.tracks import SAME_INSTANT_NS, Bool, Int
from copem_replay.io.channel import LAST_NS
from copem_replay.io.encodings.columns import DistinctTexts, any_item_path
from copem_replay.io.findings import Finding, find

# Time stamps in messages: one number, seconds and nanoseconds, or text after ISO 8601.

UNIT_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
_PAIRS = (("sec", "nanosec"), ("seconds", "nanos"), ("sec", "nsec"), ("secs", "nsecs"))
_LAST_SECOND = LAST_NS // 10**9
_ISO = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)[Tt ](\d\d):(\d\d):(\d\d)(?:[.,](\d{1,30}))?\s?(?:[Zz]|(?:UTC)|([+-])(\d\d)(?::?(\d\d))?)?",
    re.ASCII,
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def find_stamp_paths(offers: Collection[str], path: str) -> list[str]:
    """Paths of the time stamp at `path`: one, or those of seconds and nanoseconds; empty: there is no time stamp."""
    if any_item_path(path) in offers:
        return [path]
    pairs = ([f"{path}.{name}" for name in pair] for pair in _PAIRS)
    return next((both for both in pairs if all(any_item_path(p) in offers for p in both)), [])


def parse_nanoseconds(texts: Sequence[DistinctTexts], unit: str) -> tuple[Int, Bool, int]:
    """(R,) times in ns of one column, or of seconds and nanoseconds; (R,) whether each is one; how many are impossible.

    Decimal numbers are exact. A date without a zone is in UTC. Impossible: beyond `LAST_NS`, or more nanoseconds than a
    second has.
    """
    parts = [_parse_words(t, unit if len(texts) == 1 else u) for t, u in zip(texts, ("s", "ns"), strict=False)]
    stamp_ns, is_time, impossible = parts[0]
    if len(parts) == 2:
        nanos, in_second = parts[1][0], (parts[1][0] >= 0) & (parts[1][0] <= UNIT_NS["s"])
        impossible |= parts[1][2] | ~in_second
        stamp_ns, is_time = stamp_ns + nanos, is_time & parts[1][1] & in_second
    return stamp_ns, is_time, int(impossible.sum())


def _parse_words(texts: DistinctTexts, unit: str) -> tuple[Int, Bool, Bool]:
    """As `parse_nanoseconds`, of one column: (F,) ns, whether it is a time, whether it is an impossible one."""
    stamp_of_word, is_time = np.zeros(len(texts.words) + 1, dtype=np.int64), np.zeros(len(texts.words) + 1, dtype=bool)
    impossible = np.zeros(len(texts.words) + 1, dtype=bool)
    for k, word in enumerate(texts.words):
        try:
            value, scale = Decimal(word), UNIT_NS[unit]
        except ArithmeticError:  # no number
            instant_ns = _parse_date(word)
            if instant_ns is None:
                continue
            value, scale = Decimal(instant_ns), 1
        if value.is_finite() and value.copy_abs() <= _LAST_SECOND * 1_000_000_000 // scale:
            stamp_of_word[k], is_time[k] = round(value * scale), True
        else:
            impossible[k] = True
    return stamp_of_word[texts.code], is_time[texts.code], impossible[texts.code]


def _parse_date(word: str) -> int | None:
    """`2024-05-01T12:00:00.25+02:00` in ns of Unix time; None: the text is no such date."""
    date_match = _ISO.fullmatch(word.strip())
    if date_match is None:
        return None
    *parts, fraction, sign, hours, minutes = date_match.groups()
    try:
        since_epoch = datetime(*map(int, parts), tzinfo=UTC) - _EPOCH  # type: ignore[misc,arg-type]
    except ValueError:  # the 30th of February
        return None
    zone_offset = timedelta(hours=int(hours or 0), minutes=int(minutes or 0))
    since_epoch += zone_offset if sign == "-" else -zone_offset
    nanos = round(Decimal(f"0.{fraction or 0}") * 10**9)
    return (since_epoch.days * 86_400 + since_epoch.seconds) * 10**9 + nanos


# Stamps against the times of logging.

SLACK_NS = 1_000_000_000
"""Stamps and log times of one clock are no farther apart, and stamps of one run fall by no more: latencies are
shorter."""
_LEAP_NS = 3600 * 1_000_000_000
"""Stamps that leap farther ahead than log time are of another clock: one that was set, or a simulation's that came."""
_ALIKE = 0.9
"""Two clocks run alike where so many messages are stamped and logged the same time apart, within `SLACK_NS`."""


def settle_stamps(
    stamp_ns: Int, stamped: Bool, log_time_ns: Int, *, ahead_ns: Int | int = 0, noun: str = "message", noted: int = 0
) -> tuple[Int, Bool, Bool, list[Finding]]:
    """(F,) stamps, whether each is stated, whether its message is kept, and findings.

    `stamp_ns`: by the clock of the log times, which that of the messages is ahead of by `ahead_ns`. A stamp is not set
    where it is 0 in several messages, or of another clock than its neighbours'. The time of logging is taken then, by
    the clock of the stamps where both clocks run alike; where they do not, a message that was logged at another time
    than all stamps is left out. `noted`: so many stamps are impossible, and told of.
    """
    unset = _find_unset(stamp_ns, stamped, log_time_ns, stamp_ns + ahead_ns == 0)
    known, keep, findings = stamped & ~unset, np.ones(len(stamp_ns), dtype=bool), list[Finding]()
    if known.all():
        return stamp_ns, known, keep, findings
    settled = np.where(known, stamp_ns, log_time_ns)
    if known.any():
        apart_ns = stamp_ns[known] - log_time_ns[known]
        offset_ns = int(np.sort(apart_ns)[len(apart_ns) // 2])  # a median without rounding
        alike = (np.abs(apart_ns - offset_ns) <= SLACK_NS).mean() >= _ALIKE
        if alike and abs(offset_ns) > SLACK_NS:
            settled = np.where(known, stamp_ns, log_time_ns + offset_ns)
        around_ns = _LEAP_NS if alike else SLACK_NS
        span = stamp_ns[known].min() - around_ns, stamp_ns[known].max() + around_ns
        keep = known | ((settled >= span[0]) & (settled <= span[1]))
    zero, odd = (unset & (stamp_ns + ahead_ns == 0)), unset & (stamp_ns + ahead_ns != 0)
    findings += find("stamp absent", max(int((keep & ~stamped).sum()) - noted, 0), noun=noun)
    findings += find("stamp zero", int((keep & zero).sum()), noun=noun)
    findings += find("stamp odd", int((keep & odd).sum()), noun=noun)
    findings += find("stamp lost", int((~keep).sum()), noun=noun)
    return settled, known, keep, findings


def _find_unset(stamp_ns: Int, stamped: Bool, log_time_ns: Int, zero: Bool) -> Bool:
    """(F,) stated stamps that are not set: zeros, if several, and those of another clock than their neighbours'."""
    unset = stamped & zero if (stamped & zero).sum() > 1 else np.zeros(len(stamp_ns), dtype=bool)
    rows = np.flatnonzero(stamped & ~unset)
    rows = rows[np.argsort(log_time_ns[rows], kind="stable")]
    if len(rows) > 2:
        is_lone = _find_lone(stamp_ns[rows], log_time_ns[rows])
        unset[rows[is_lone]] = True
        rows = rows[~is_lone]
    leaps = np.flatnonzero(np.diff(stamp_ns[rows]) > np.diff(log_time_ns[rows]) + _LEAP_NS)
    if len(leaps):
        parts = np.split(rows, leaps + 1)
        largest_part = max(parts, key=len)
        unset[np.setdiff1d(rows, largest_part)] = True
    return unset


def _find_lone(stamp_ns: Int, log_time_ns: Int) -> Bool:
    """(F,) stamps in order of logging that fit neither neighbour, though the neighbours fit each other."""

    def fits(step: int) -> Bool:
        apart_ns = stamp_ns[step:] - stamp_ns[:-step]
        fitting: Bool = (apart_ns >= -SLACK_NS) & (apart_ns <= log_time_ns[step:] - log_time_ns[:-step] + SLACK_NS)
        return fitting

    next_fits, after_next_fits = fits(1), fits(2)
    lone = np.zeros(len(stamp_ns), dtype=bool)
    lone[1:-1] = ~next_fits[:-1] & ~next_fits[1:] & after_next_fits
    lone[0] = ~next_fits[0] & next_fits[1] & ~after_next_fits[0]
    lone[-1] = ~next_fits[-1] & next_fits[-2] & ~after_next_fits[-1]
    return lone


def find_runs(stamp_ns: Int, log_time_ns: Int) -> Int:
    """(F,) the run of each message, from 0: a new one begins where stamps fall by more than a second, logged later."""
    order = np.argsort(log_time_ns, kind="stable")
    falls = (np.diff(stamp_ns[order]) < -SLACK_NS) & (np.diff(log_time_ns[order]) > 0)
    run = np.empty(len(stamp_ns), dtype=np.int64)
    run[order] = np.concatenate([[0], np.cumsum(falls)])[: len(order)]
    return run


def refuse_second_run(
    stamp_ns: Int, log_time_ns: Int, list_contents: Callable[[], Sequence[bytes]], path: Path, topic: str
) -> None:
    """Raises RecordingError where messages are of several runs, unless a run repeats the first message by message.

    `list_contents`: gives the content of each message, as bytes.
    """
    run = find_runs(stamp_ns, log_time_ns)
    if not run.any():
        return
    start_ns, contents = int(log_time_ns.min()), list_contents()
    messages = {(int(stamp_ns[k]), contents[k]) for k in np.flatnonzero(run == 0).tolist()}
    latest_ns = int(stamp_ns[run == 0].max())
    for number in range(1, int(run.max()) + 1):
        rows = np.flatnonzero(run == number)
        again = [(int(stamp_ns[k]), contents[k]) for k in rows.tolist()]
        if any(one not in messages and one[0] <= latest_ns + SAME_INSTANT_NS for one in again):
            break
        messages.update(again)
        latest_ns = max(latest_ns, int(stamp_ns[rows].max()))
    else:
        return
    ends = [(log_time_ns[run == n].min() - start_ns, log_time_ns[run == n].max() - start_ns) for n in np.unique(run)]
    windows = " or ".join(f"`window_s: [{a * 1e-9:.10g}, {b * 1e-9:.10g}]`" for a, b in ends[:_SHOWN])
    more = f", … ({len(ends)} in all)" if len(ends) > _SHOWN else ""
    raise RecordingError(
        f"time goes back {len(ends) - 1} times, so it holds {len(ends)} runs, which are no single log: choose one with "
        f"{windows}{more} in the experiment".replace("1 times", "once"),
        path=path,
        topic=topic,
    )


_SHOWN = 6  # windows named in an error, at most
