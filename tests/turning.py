"""The two hypotheses about the paper's cell written out for one cell, slowly: the reference of TurningInversion."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ohmskin.cell import PaperModel
from ohmskin.cell.estimation import DOUBT, LOADS, UNKNOWN, USUAL
from ohmskin.cell.inversions import _doubts as doubts
from ohmskin.cell.inversions import _earlier as third
from ohmskin.cell.inversions import _limits as limits
from ohmskin.cell.inversions import _onset as onset
from ohmskin.cell.inversions import _recovery as recovery
from ohmskin.cell.inversions import _released as release
from ohmskin.cell.inversions import _still as still
from ohmskin.cell.inversions import _sway as sway
from ohmskin.cell.inversions import _takeover as takeover
from ohmskin.cell.inversions import _turning_rows as rows
from ohmskin.cell.inversions import _turns as turns
from ohmskin.cell.inversions import _variances as variances
from ohmskin.cell.inversions import _way as way
from ohmskin.cell.materials import _lag as lag


@dataclass
class Hypothesis:
    """Pressure in kPa, and what one of the two models remembers."""

    pressure: float
    settled: float
    x2: float
    x3: float


class OneCell:
    """One cell whose first reading is that of a load held for ever."""

    def __init__(self, model: PaperModel, full_scale_kpa: float, r: float, *, exact: bool) -> None:
        self.model, self.full, self.exact = model, full_scale_kpa, exact
        p = r / model.gain_per_kpa
        self.now = Hypothesis(p, p, p / model.e2_kpa, p / model.e3_kpa)
        self.other = Hypothesis(p, p, p / model.e2_kpa, p / model.e3_kpa)
        self.rising = True
        self.extreme = self.recent_extreme = self.peak = p
        self.left: float | None = None
        self.earlier, self.earlier_least, self.earlier_from = 0.0, 0.0, 0.0
        self.forgotten = 0.0
        self.highest_mean = self.fallen = 0.0
        self.doubt = self.variance = 0.0
        self.rest_variance = self.drift = self.last_drift = 0.0
        self.rested, self.taken_off, self.released, self.taken_before = False, 0.0, 0.0, 0.0
        self.still, self.onset = Still(), Onset()
        self.sway = Sway(r)
        self.last = self.before_last = self.third_last = p

    def step(self, dt: float, r: float, std: float, doubt: float) -> float:
        """Take a reading, uncertain by ``std`` by noise and by ``doubt`` in all; the pressure."""
        m, self.r = self.model, r
        self.third_last, self.before_last, self.last = self.before_last, self.last, self.now.pressure
        gains = {rising: self._solved(Hypothesis(0, 0, 0, 0), rising, dt, 1.0).pressure for rising in (True, False)}
        now, other = self._solved(self.now, self.rising, dt, r), self._solved(self.other, not self.rising, dt, r)
        if self.variance > (DOUBT * self.full) ** 2:
            if now.pressure > USUAL * self.full:
                self.doubt = max(self.doubt, (UNKNOWN * self.full) ** 2)
                if self.rising and other.pressure <= USUAL * self.full:
                    self.extreme = rows.REFUTED
            now, other = self._believable(now, self.rising, r), self._believable(other, not self.rising, r)
        rates = (1 - 1 / (m.etau2_kpa / m.eu1_kpa + 1)) / m.tu_s, (1 + m.e1_kpa / m.e2_kpa) / m.t2_s
        self.earlier *= np.exp(-dt * rates[self.rising == (self.left is None)])
        seeming = self.drift
        if self.rising:
            rise_r, fall_r = 1 / m.eu1_kpa + 1 / m.etau2_kpa, 1 / m.e1_kpa
            fall = max(self.extreme - other.pressure - turns.CLEAR_FALL * self.full, 0.0)
            seeming = min(seeming, turns.SHARED_FALL * fall_r / rise_r * fall)
            if self.third_last - now.pressure > turns.FALLING * std * gains[True] or self.fallen > turns.RELEASED:
                seeming = 0.0
        unsure = std * gains[self.rising]
        sure = turns.SURE_SEEN if self.fallen > turns.SEEN_FALLING else rows.SURE
        turned = self.extreme - self._ahead(now) > sure * unsure + self._turn_from(self.extreme) + seeming
        least = turns.FALLING * unsure + turns.LIGHT_TURN * self.full + (seeming if self.rising else 0.0)
        turned = turned or self.recent_extreme - self._ahead(now) > least
        if self.left is not None:
            direction = 1.0 if self.rising else -1.0
            turned = turned or -direction * other.pressure > self.left - std * gains[not self.rising]
        refuted = False
        if self.rising == (self.left is not None) and (self.rising or turned):
            rising, recovers = (now, other) if self.rising else (other, now)
            begun = self.extreme if self.left is None else self.left  # the pressure then, with its sign turned
            rise = begun + rising.pressure
            clear = rise > turns.CLEAR_RISE * self.full + rows.SURE * std * gains[True]
            seeming = turns.LESS * std * gains[False]
            refuted = clear and begun + recovers.pressure < turns.SHARED * rise + seeming
        if refuted:
            turned = self.rising
        if turned:
            earlier = 0.0
            if self.left is None and self.rising:
                earlier = third.MIDWAY * self._turned_earlier(0.0, std * gains[True])
            if self.left is None:
                earlier = max(earlier, self.forgotten)
            self.forgotten = 0.0
            noticed = self.left is None and self.extreme < rows.REFUTED
            released = self.extreme if noticed and self.rising else 0.0
            now, other = other, now
            self.rising = not self.rising
            again, left = self.left is not None, self.left
            unsure = std * gains[self.rising]
            self.left = None if again else self.extreme
            sign = 1.0 if self.rising else -1.0
            there = max(sign * (self.third_last - self.before_last), sign * (self.before_last - self.last), 0.0)
            way = min(takeover.JUST_BEGUN * there, abs(now.pressure - self.last))
            bend = 1 / m.eu1_kpa + 1 / m.etau2_kpa - 1 / m.e1_kpa
            fast = max(1.0, abs(now.pressure - self.last) / (takeover.FAST * turns.TURN * self.full))
            way = max(way - rows.SURE * unsure, 0.0)
            unseen = takeover.BETWEEN * way * bend * gains[self.rising] + takeover.ROUND * self.full / fast
            if noticed and self.rising:
                unseen += self._hidden(now.pressure, other.pressure)
            self.fallen = 0.0
            self.onset.looks = 0 if noticed and not self.rising else self.onset.looks
            may_bear, self.onset.may_bear = self.onset.may_bear, 0.0
            now = self._gone_further(now, earlier)
            self.earlier -= earlier
            ahead = sign * max(now.pressure, 0)
            self.extreme = left if again else ahead - turns.LESS * unsure
            self.peak = left if again else ahead - unsure
            self.recent_extreme = self.extreme
            before = self.variance
            if self.rested:
                clear = self.released**2 > recovery.TWICE * self.taken_before
                self.taken_before = max(self.taken_off**2, 0.0 if clear else self.taken_before)
                left_over = recovery.LIGHT * before + self.taken_before + may_bear**2
                before = min(before, self.rest_variance + left_over)
            by_noise = (gains[False] * std) ** 2
            self.doubt = (np.sqrt(before) + unseen) ** 2 + by_noise
            self.doubt = min(self.doubt, (UNKNOWN * self.full) ** 2)
            self.variance = self.doubt
            lost = self.doubt >= (recovery.MOST * self.full) ** 2
            sagged = third.EARLIER * max(self.earlier, 0.0) if noticed and not self.rising else 0.0
            usual = recovery.PART * max(self.doubt - by_noise, 0.0) + min(by_noise, self.doubt)
            self.rest_variance = (0.0 if lost else usual) + sagged**2
            self.rested, self.drift, self.taken_off, self.released = False, 0.0, 0.0, released
            error = min(np.sqrt(self.doubt), recovery.MOST * self.full)
            self.last_drift = recovery.DRIFTS * error
        unsure = std * gains[self.rising]
        ahead = self._ahead(now)
        if refuted:
            self.extreme, self.peak = ahead - turns.LESS * unsure, ahead - unsure
            self.recent_extreme = self.extreme
        confirmed = False
        if self.left is not None:
            back = self.left + (1.0 if self.rising else -1.0) * other.pressure
            times = rows.CONFIRMED_RISE if self.rising else rows.CONFIRMED_FALL
            if back >= times * (rows.SURE * std * gains[not self.rising] + self._turn_from(self.left)):
                self.left, confirmed = None, True
        allowed = -limits.PULL_SIGMAS * gains[False] * doubt - limits.NEAR * self.full
        if not self.rising:
            allowed = min(allowed, -rows.SURE * gains[False] * std)
        if not self.exact and now.pressure < allowed:
            begun = self._begun(allowed, r, now.x3)
            if self.rising:
                now = Hypothesis(allowed, begun.settled, now.x2, now.x3)
            else:
                now = Hypothesis(allowed, now.settled, begun.x2, now.x3)
            missing = max((allowed / self.model.e1_kpa - r) * gains[True], 0.0)
            more = max(min(missing, limits.MOST_LOST * self.full) ** 2 - self.doubt, 0.0)
            self.doubt, self.variance = self.doubt + more, self.variance + more
        direction = 1.0 if self.rising else -1.0
        held = direction * (self.third_last - now.pressure) < 3 * dt * doubts.HELD_PER_S * self.full
        below = self.peak - ahead
        share = doubts.AGAIN if below < unsure else 0.0
        share = 1.0 if below <= turns.EXACTLY * self.full else share
        if self.left is not None:
            share = 0.0
        begun = self._begun(now.pressure, r, now.x3)
        forgotten = share * direction * (now.pressure - other.pressure)
        self.earlier += forgotten
        self.other = Hypothesis(
            *(old + share * (new - old) for old, new in zip(vars(other).values(), vars(begun).values(), strict=True))
        )
        self.now = now
        self._follow_earlier_turn(gains[self.rising] * std, confirmed)
        self.peak = max(self.peak, ahead - unsure)
        self.extreme = max(self.extreme, ahead - turns.LESS * unsure)
        rate = (1 - 1 / (m.etau2_kpa / m.eu1_kpa + 1)) / m.tu_s if self.rising else (1 + m.e1_kpa / m.e2_kpa) / m.t2_s
        was_apart = self.variance - self.doubt - self.onset.may_bear**2
        fade = np.exp(-2 * dt * rate)
        fallen = direction * (self.last - now.pressure) if self.left is None else 0.0
        self.forgotten += min(forgotten, third.OF_FALL * fallen)
        self.forgotten *= max(1 - third.LASTS * (1 - fade), 0.0) if fallen >= 0 else 0.0
        self.forgotten = max(self.forgotten, 0.0)
        self.recent_extreme -= (1 - fade) * np.sqrt(self.doubt) + doubts.CREEP * self.full * dt
        self.recent_extreme = max(self.recent_extreme, ahead - turns.LESS * unsure)
        if held:
            self.peak -= doubts.GOES_BACK * (1 - fade) * min(np.sqrt(self.doubt), turns.TURN * self.full)
        self.doubt *= fade
        is_apart = doubts.EITHER * abs(self.other.pressure - now.pressure)
        if self.left is None:
            fallen = third.FALLEN * (self.peak - direction * now.pressure) if held else 0.0
            is_apart += third.EARLIER * self._turned_earlier(fallen, unsure)
        is_apart *= is_apart
        lost = was_apart - is_apart
        least = max(doubts.LOST * unsure, limits.NEAR * self.full) ** 2
        if lost > doubts.GONE * was_apart and was_apart > least and not confirmed:
            self.doubt = min((np.sqrt(self.doubt) + np.sqrt(lost)) ** 2, (limits.MOST_LOST * self.full) ** 2)
        self.variance = self.doubt + is_apart + self.onset.may_bear**2
        return now.pressure

    def recover(self, dt: float, mean: float, noise: float, count: int) -> None:
        """Take the ``mean`` of the last four readings, each uncertain by ``noise``."""
        self._rest(dt, mean, noise, count)
        self._release(dt, mean, noise)
        self._compare(dt, mean, noise)
        self._begin(dt, mean, noise)

    def look(self, dt: float, mean: float, noise: float) -> None:
        """Take the ``mean`` of the readings since the last look, each uncertain by ``noise``: do they go to and fro?"""
        full_r, bears = self._fast_r()[0] * self.full, not self.rested and self.now.pressure > 0
        unseen = self.sway.look(dt, mean, noise, self.rising, full_r, self._leaps(dt, noise), bears)
        self._take_back(dt, *unseen)

    def _leaps(self, dt: float, noise: float) -> bool:
        """Whether the pressure has just gone further than unnoticed."""
        gain = self._solved(Hypothesis(0, 0, 0, 0), self.rising, dt, 1.0).pressure
        apart = max(abs(self.now.pressure - self.last), abs(self.last - self.third_last))
        edge = variances.CLEAR * np.sqrt(2 / sway.readings(dt))
        return bool(apart > edge * noise * gain + sway.unnoticed(dt) * self.full)

    def _fast_r(self) -> tuple[float, float]:
        """R per kPa of a fast rise and of a fast fall."""
        return 1 / self.model.eu1_kpa + 1 / self.model.etau2_kpa, 1 / self.model.e1_kpa

    def _take_back(self, dt: float, unseen: float, most: float, told: float) -> None:
        """Subtract what an ``unseen`` way of r makes of the pressure, of a way that is ``told`` and is ``most``."""
        m, now, (rise, fall) = self.model, self.now, self._fast_r()
        p, x3 = now.pressure, now.x3
        x2 = self.r - p / m.e1_kpa - x3 if self.rising else now.x2
        settled = now.settled if self.rising else p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * self.r
        recovers = (p / m.e2_kpa - x2) / m.t2_s + (p / m.e3_kpa - x3) / m.t3_s
        sinks = (settled - p) / m.etau2_kpa / m.tu_s
        # Half of the way goes each way; so does half of the time, in which r drifts as the other model says.
        drifts = (recovers / fall - sinks / rise) * sway.readings(dt) * dt / 2 * (1 if self.rising else -1)
        kept = (1 / fall - 1 / rise) / 2
        shown = 0.0 if self.rested else max(p, 0.0)
        kpa = unseen * kept + drifts * min(unseen / told, 1.0) if unseen > 0 else 0.0
        kpa = min(max(kpa, 0.0), shown)
        for one in (self.now, self.other):
            one.pressure -= kpa
            one.settled -= kpa * (1 + m.etau2_kpa / m.eu1_kpa)
            one.x2 += kpa / m.e1_kpa
        self.last, self.before_last, self.third_last = self.last - kpa, self.before_last - kpa, self.third_last - kpa
        ahead = kpa if self.rising else -kpa
        self.extreme, self.peak = self.extreme - ahead, self.peak - ahead
        self.recent_extreme, self.highest_mean = self.recent_extreme - ahead, self.highest_mean - kpa
        if self.left is not None:
            ahead = -ahead
            self.left -= ahead
        self.earlier_least, self.earlier_from = self.earlier_least - ahead, self.earlier_from - ahead
        more = max(most - unseen, 0.0) * kept + sway.UNSURE * kpa
        if more > 0:
            doubt = min((np.sqrt(self.doubt) + more) ** 2, max(self.doubt, shown**2))
            self.variance += doubt - self.doubt
            self.doubt = doubt

    def _rest(self, dt: float, mean: float, noise: float, count: int) -> None:
        """A released cell is at rest."""
        m = self.model
        gain = self._solved(Hypothesis(0, 0, 0, 0), False, dt, 1.0).pressure
        rate = (1 + m.e1_kpa / m.e2_kpa) / m.t2_s
        self.peak = self.peak + recovery.PEAK_FADES * (self.extreme - self.peak)
        self.rest_variance *= np.exp(-8 * dt * rate)  # of a variance, in four frames
        self.taken_before *= np.exp(-8 * dt * rate)
        if self.rising:
            rate = (1 - 1 / (m.etau2_kpa / m.eu1_kpa + 1)) / m.tu_s
        self.drift += (1 - np.exp(-4 * dt * rate)) * (self.last_drift + max(self.taken_off, 0.0) - self.drift)
        if self.rising and count >= recovery.OLD:
            rising_gain = self._solved(Hypothesis(0, 0, 0, 0), True, dt, 1.0).pressure
            self.drift = max(self.drift, recovery.OVERSHOOT * noise * rising_gain)
        if self.rising or self.left is not None:
            return
        ago = 1.5 * dt
        pressure = gain * (mean - self.now.x2 * np.exp(ago / m.t2_s) - self.now.x3 * np.exp(ago / m.t3_s))
        by_noise = (gain * noise) ** 2 / 4
        left = self.now.pressure + self.taken_off
        if self.released - left < recovery.FELL * left and self.released > 0:
            return
        if max(pressure**2, self.now.pressure**2) >= recovery.REST_SIGMAS**2 * (self.rest_variance + by_noise):
            return
        moved = max(abs(self.third_last - self.now.pressure) - recovery.STEADY * gain * noise, 0.0)
        unsure = by_noise + (recovery.GOES_ON * moved) ** 2
        kept = unsure / (unsure + self.rest_variance)
        error = pressure * (1 - kept)
        self.rest_variance *= kept
        self.rested = self.rested or moved == 0.0
        self.taken_off += error
        more = max(self.taken_off**2 - self.doubt, 0.0)
        self.doubt, self.variance = self.doubt + more, self.variance + more
        self.now = self._begun(self.now.pressure - error, self.r, self.now.x3)
        self.other = self._begun(self.now.pressure, self.r, self.now.x3)
        self.extreme, self.peak = min(self.extreme + error, 0.0), min(self.peak + error, 0.0)
        self.recent_extreme = min(self.recent_extreme + error, 0.0)

    def _release(self, dt: float, mean: float, noise: float) -> None:
        """Sum up by how much means of readings are below the highest, under a load that rises."""
        m, (rise_r, fall_r) = self.model, self._fast_r()
        rises, recovers = (self.now, self.other) if self.rising else (self.other, self.now)
        gain = self._solved(Hypothesis(0, 0, 0, 0), True, dt, 1.0).pressure
        sunk = (self.r - rises.pressure / m.eu1_kpa) * (1 - np.exp(-1.5 * dt / m.tu_s))
        pressure, by_noise = rises.pressure + gain * (mean - sunk - self.r), gain * noise / 2
        begun, below = pressure - release.LESS * by_noise, self.highest_mean - pressure
        if not self.rising or begun > self.highest_mean or by_noise > release.LOUD * self.full:
            self.highest_mean, self.fallen = begun, 0.0
            return
        by_change = (self.extreme - rises.pressure) * rise_r / fall_r
        held = max(self.extreme - recovers.pressure - by_change, 0.0)
        below -= turns.TURN * self.full + turns.SHARED_FALL * fall_r / rise_r * held
        self.fallen = max(self.fallen + below / by_noise - release.ALLOWED, 0.0)
        self.highest_mean += (1 - np.exp(-4 * dt / release.LASTS_S)) * min(pressure - self.highest_mean, 0.0)

    def _compare(self, dt: float, mean: float, noise: float) -> None:
        """The load may be what it was before."""
        m, was, ago = self.model, self.still, 1.5 * dt
        was.x2, was.x3 = was.x2 * np.exp(-4 * dt / m.t2_s), was.x3 * np.exp(-4 * dt / m.t3_s)
        p = self.now.pressure
        if not self.rising:
            if self.left is None:
                load = max(p, 0.0)
                self.still = Still(load, self.now.x2 - load / m.e2_kpa, self.now.x3 - load / m.e3_kpa)
            return
        gain = self._solved(Hypothesis(0, 0, 0, 0), False, dt, 1.0).pressure
        noise_kpa = still.SURE * noise / 2 * gain
        bears = was.x2 * np.exp(ago / m.t2_s) + was.x3 * np.exp(ago / m.t3_s)
        off = gain * (mean - was.load * (1 / m.e1_kpa + 1 / m.e2_kpa + 1 / m.e3_kpa) - bears)
        growth = p - was.pressure
        light = was.pressure <= was.load + still.LIGHT_TOUCH * self.full and self.onset.looks >= 0
        flat, clear = (still.FLAT, still.CLEAR) if light else (still.FLAT_PRESS, still.CLEAR_PRESS)
        alike = was.off is not None and abs(off - was.off) <= flat * max(growth, 0) + noise_kpa
        if not alike or abs(off) > still.LIGHT_TOUCH * self.full + noise_kpa:
            was.off, was.pressure = off, p
            return
        if growth > max(clear * self.full, noise_kpa / flat):
            x3 = was.x3 + was.load / m.e3_kpa
            self.other = Hypothesis(was.load, self.other.settled, self.r - was.load / m.e1_kpa - x3, x3)
            self.extreme = rows.REFUTED

    def _begin(self, dt: float, mean: float, noise: float) -> None:
        """A load may have begun to rise while the cell recovers."""
        m, seen, ago = self.model, self.onset, 1.5 * dt
        seen.x2, seen.x3 = seen.x2 * np.exp(-4 * dt / m.t2_s), seen.x3 * np.exp(-4 * dt / m.t3_s)
        for load in (seen.earliest, seen.begun):
            load.rise(m, 4 * dt, self.r)
        gain = self._solved(Hypothesis(0, 0, 0, 0), False, dt, 1.0).pressure
        bound = recovery.REST_SIGMAS**2 * (self.rest_variance + (gain * noise) ** 2)
        if self.rising or self.left is not None or not (self.now.pressure**2 < bound or seen.looks > 0):
            return
        seen.looks = abs(seen.looks) + 1
        if seen.looks < onset.SETTLES:
            return
        by_model, by_noise = self.rest_variance + onset.MODEL * self.doubt, (gain * noise) ** 2 / 4
        weight = max(by_model / (by_model + by_noise), onset.AVERAGED)
        expected = seen.x2 * np.exp(ago / m.t2_s) + seen.x3 * np.exp(ago / m.t3_s)
        seen.pull += weight * (gain * (expected - mean) - seen.pull)
        none, load_kpa = onset.NONE * self.full, seen.begun.pressure
        by_noise = by_noise * weight / (2 - weight) + none**2
        unsure = np.sqrt(by_model + by_noise)
        sigmas = seen.pull / unsure
        likely = np.clip((sigmas - onset.SOME_SIGMAS) / (onset.CLEAR_SIGMAS - onset.SOME_SIGMAS), 0, 1)
        lasts, shown = seen.may_bear * np.exp(-4 * dt / onset.LASTS_S), max(self.now.pressure, 0)
        may_bear = max(lasts, np.sqrt(likely) * max(load_kpa - shown, 0))
        held_kpa = self.other.pressure + self.earlier
        was_held = -self.earlier_from > onset.HELD * held_kpa
        risen = max(load_kpa, held_kpa) if was_held else load_kpa
        hidden = onset.HIDDEN * max(min(self._rises_unseen(onset.HIDES_S), seen.earliest.pressure) - shown, 0)
        if seen.looks == onset.SETTLES:
            seen.earliest, seen.clear_pull = Rise(0.0, -m.etau2_kpa * (self.now.x2 + self.now.x3)), 0.0
        if seen.looks == onset.SETTLES or seen.pull <= none + onset.COINCIDENCE * load_kpa or load_kpa < -unsure:
            seen.x2, seen.x3, seen.pull, seen.clear_pull = self.now.x2, self.now.x3, 0.0, 0.0
            seen.begun = Rise(0.0, -m.etau2_kpa * (seen.x2 + seen.x3))
            may_bear = lasts
        elif sigmas > onset.CLEAR_SIGMAS and seen.clear_pull == 0:
            seen.clear_pull, may_bear = seen.pull, max(may_bear, hidden)
        elif (
            sigmas > onset.CLEAR_SIGMAS
            and seen.pull > seen.clear_pull + onset.MORE_SIGMAS * np.sqrt(by_noise)
            and risen > onset.CLEAR * self.full
        ):
            settled = risen + m.etau2_kpa * (risen / m.eu1_kpa - self.r)
            self.other = Hypothesis(risen, settled, self.other.x2, self.now.x3)
            self.extreme, self.rested, seen.looks = rows.REFUTED, False, -seen.looks
            self.doubt += (onset.EITHER * risen) ** 2 + hidden**2
            self.variance, seen.may_bear = self.doubt, 0.0
            seen.found += 1
            return
        elif sigmas > onset.CLEAR_SIGMAS:
            may_bear = max(may_bear, hidden)
        self.variance += may_bear**2 - seen.may_bear**2
        seen.may_bear = may_bear

    def _rises_unseen(self, seconds: float) -> float:
        """KPa of a load that rises while the readings go on as at rest, from the first microsecond on."""
        m, x2, x3, begin_s = self.model, self.now.x2, self.now.x3, 1e-6
        load = Rise(0.0, -m.etau2_kpa * (x2 + x3))
        load.rise(m, begin_s, x2 * np.exp(-begin_s / m.t2_s) + x3 * np.exp(-begin_s / m.t3_s))
        return load.pressure * seconds / begin_s

    def _hidden(self, pressure: float, recovers: float) -> float:
        """By how much a rise may be larger that may have begun earlier."""
        m, rise = self.model, pressure + self.extreme
        if self.onset.looks < onset.SETTLES or rise <= 0:
            return 0.0
        fast = m.e1_kpa * (1 / m.eu1_kpa + 1 / m.etau2_kpa)
        hidden = np.clip(1 - (recovers + self.extreme) / rise / fast, 0, 1)
        return float(onset.HIDDEN_SHARE * hidden**2 * max(self.onset.earliest.pressure - pressure, 0))

    def _gone_further(self, now: Hypothesis, kpa: float) -> Hypothesis:
        """The hypothesis taken over, whose load turned before: less goes back, more is remembered of it."""
        m = self.model
        if self.rising:
            settled = now.settled + kpa * (1 + m.etau2_kpa / m.eu1_kpa)
            return Hypothesis(now.pressure + kpa, settled, now.x2, now.x3)
        return Hypothesis(now.pressure - kpa, now.settled, now.x2 + kpa / m.e1_kpa, now.x3)

    def _follow_earlier_turn(self, unsure: float, confirmed: bool) -> None:
        """Begin the hypothesis anew that the load turned earlier, where its pressure has gone on as before."""
        m = self.model
        ratio = m.e1_kpa * (1 / m.eu1_kpa + 1 / m.etau2_kpa)
        rose = self.rising == (self.left is None)
        recovery, rising = (self.other, self.now) if self.rising else (self.now, self.other)
        other = recovery.pressure if rose else -rising.pressure
        sign = 1.0 if rose else -1.0
        self.earlier = min(self.earlier, other + (0.0 if rose else USUAL * self.full))
        self.earlier_least = min(self.earlier_least, other - self.earlier)
        gone_on = other - self.earlier - self.earlier_least - rows.SURE * unsure * ratio**sign
        if gone_on > 0:
            self.earlier_from += sign * (self.now.pressure - self.last)
        if confirmed or gone_on > self._turn_from(self.extreme) * min(1.0, ratio**sign):
            self.earlier, self.earlier_least, self.earlier_from = 0.0, other, sign * self.now.pressure

    def _turned_earlier(self, fallen: float, unsure: float) -> float:
        """By how much the pressure would be less if the load had turned earlier; none if it seems constant."""
        grown = max(self.peak - self.earlier_from, fallen, 0.0)
        if self.rested and not self.rising:
            return 0.0
        errors = third.GROWN_ERRORS if self.rising else third.GROWN_RELEASED
        least = third.GROWN_SIGMAS * unsure + errors * np.sqrt(self.doubt)
        least += third.GROWN * turns.LIGHT_TURN * self.full
        return max(self.earlier, 0.0) * grown**2 / (grown**2 + least**2)

    def _turn_from(self, extreme: float) -> float:
        """How far an exact pressure must go back for a turn."""
        return min(turns.LIGHT_TURN * self.full + turns.TURN_SHARE * abs(extreme), turns.TURN * self.full)

    def _ahead(self, hypothesis: Hypothesis) -> float:
        least = LOADS[0] * self.full if self.exact else 0.0
        return (1 if self.rising else -1) * max(hypothesis.pressure, least)

    def _believable(self, hypothesis: Hypothesis, rising: bool, r: float) -> Hypothesis:
        """The same with a pressure that is not beyond the usual."""
        most = USUAL * self.full
        if hypothesis.pressure <= most:
            return hypothesis
        begun = self._begun(most, r, hypothesis.x3)
        settled, x2 = (begun.settled, hypothesis.x2) if rising else (hypothesis.settled, begun.x2)
        return Hypothesis(most, settled, x2, hypothesis.x3)

    def _begun(self, p: float, r: float, x3: float) -> Hypothesis:
        """What a model remembers that begins at a pressure and a reading."""
        m = self.model
        return Hypothesis(p, p * (1 + m.etau2_kpa / m.eu1_kpa) - m.etau2_kpa * r, r - p / m.e1_kpa - x3, x3)

    def _solved(self, before: Hypothesis, rising: bool, dt: float, r: float) -> Hypothesis:
        """The hypothesis after a step whose pressure one of the models gives."""
        m, p0 = self.model, before.pressure
        gone, ramp = lag.weights(dt, np.array([m.tu_s, m.t2_s, m.t3_s]))
        e2, e3 = m.e2_kpa, m.e3_kpa
        settled = before.settled + (p0 - before.settled) * gone[0] - p0 * ramp[0]
        x2 = before.x2 + (p0 / e2 - before.x2) * gone[1] - p0 / e2 * ramp[1]
        x3 = before.x3 + (p0 / e3 - before.x3) * gone[2] - p0 / e3 * ramp[2]
        if rising:  # r = p/Eu1 + (p - settled)/etau2
            p = (r + settled / m.etau2_kpa) / (1 / m.eu1_kpa + (1 - ramp[0]) / m.etau2_kpa)
        else:  # r = p/E1 + x2 + x3
            p = (r - x2 - x3) / (1 / m.e1_kpa + ramp[1] / e2 + ramp[2] / e3)
        p = float(np.clip(p, LOADS[0] * self.full, LOADS[1] * self.full))
        return Hypothesis(p, settled + ramp[0] * p, x2 + ramp[1] / e2 * p, x3 + ramp[2] / e3 * p)


@dataclass
class Rise:
    """The rising model from some moment on: pressure in kPa, and its second state."""

    pressure: float = 0.0
    settled: float = 0.0

    def rise(self, model: PaperModel, dt: float, r: float) -> None:
        """Take the next reading."""
        gone, ramp = lag.weights(dt, model.tu_s)
        settled = self.settled + (self.pressure - self.settled) * gone - self.pressure * ramp
        self.pressure = (r + settled / model.etau2_kpa) / (1 / model.eu1_kpa + (1 - ramp) / model.etau2_kpa)
        self.settled = settled + ramp * self.pressure


@dataclass
class Onset:
    """When a load may have begun to rise, what the branches bear if none has, and the pull that this needs."""

    looks: int = 0
    earliest: Rise = field(default_factory=Rise)
    begun: Rise = field(default_factory=Rise)
    x2: float = 0.0
    x3: float = 0.0
    pull: float = 0.0
    clear_pull: float = 0.0
    may_bear: float = 0.0
    found: int = 0


@dataclass
class Still:
    """The load that may be the same again, what the branches bear beyond it, and where the comparison began."""

    load: float = 0.0
    x2: float = 0.0
    x3: float = 0.0
    off: float | None = None
    pressure: float = 0.0


class Sway:
    """The way of a load that goes to and fro unnoticed, in r."""

    def __init__(self, r: float) -> None:
        self.last, self.extreme, self.rising, self.held = r, r, True, 10**6
        self.unexplained, self.back, self.told, self.may, self.way = [0.0] * 20, 0, 0.0, 0.0, Way()

    def look(
        self, dt: float, mean: float, noise: float, rising: bool, full_r: float, leaps: bool, bears: bool
    ) -> tuple[float, ...]:
        """Take the ``mean`` of the last readings: the way less that of turns, at most that, and all of it."""
        count, largest = sway.readings(dt), sway.unnoticed(dt) * full_r
        turned, explained = rising != self.rising, 0.0
        if turned or (mean > self.extreme if rising else mean < self.extreme):
            explained, self.extreme = mean - self.extreme, mean
        late, all_back = min(int(np.ceil(sway.LATE_S / (count * dt))), sway.LATE_LOOKS), 0.0
        now = self.unexplained[-1] + mean - self.last - explained
        if turned:  # explains all that r went since the extreme; what is older than `late` looks, the meter knows
            if self.back >= late:
                all_back = 2 * abs(now - self.way.seen[-1])
            back = min(self.back, sway.LATE_LOOKS)
            self.unexplained[len(self.unexplained) - back :] = [now] * back
        self.unexplained.append(now)
        self.back = 0 if turned or explained else self.back + 1
        self.last, self.rising = mean, rising
        self.held += 1
        if leaps or abs(explained) > variances.CLEAR * noise * np.sqrt(2 / count) + largest:
            self.held = 0
        if self.held <= late:
            self.way.forget()
        told, most = self.way.look(count, dt, self.unexplained[-1 - late], noise, largest)
        owed = way.MEMORY_S / (count * dt)
        if not bears or self.held < owed:
            told = most = 0.0
        of_told = float(np.clip(self.told + told - all_back, -owed * told, owed * told))
        of_most = float(np.clip(self.may + most - all_back, -owed * most, owed * most))
        self.told, self.may = min(of_told, 0.0), min(of_most, 0.0)
        return max(of_told, 0.0), max(of_most, 0.0), told


class Way:
    """Means of successive blocks of readings compared, of one, two, four and eight looks."""

    def __init__(self) -> None:
        self.seen: list[float] = []
        self.forget()

    def forget(self) -> None:
        """Begin with what noise makes."""
        self.bends = dict.fromkeys((1, 2, 4, 8), 1.0)
        self.sides = {(length, side, order): 0.5 for length in (1, 2, 4, 8) for side in (1, -1) for order in (1, 2)}

    def look(self, count: int, dt: float, mean: float, noise: float, largest: float) -> tuple[float, float]:
        """Take the ``mean`` of ``count`` readings of such ``noise``: way that is told, and the most of it."""
        noise *= np.sqrt(4 / count)
        self.seen.append(mean)
        told, most, rest, rest_of_most, caution = 0.0, 0.0, 1.0, 1.0, sway.caution(dt)
        bound = np.inf
        for length in (1, 2, 4, 8):
            share = float(np.clip(count * dt * length / way.MEMORY_S, way.LEAST_SHARE, caution.most_share))
            if len(self.seen) % length == 0:
                self._compare(length, share, noise, largest)
            up, down, up_again, down_again = (self.sides[length, side, order] for order in (1, 2) for side in (1, -1))
            sure = np.sqrt(share * way.OF_SIDES**2 + way.NOISE_KNOWN**2)
            clear = (2 * min(up_again, down_again) - 1) / sure
            moved = max(min(up + down, way.SIDE * min(up, down)) - 1, 0.0)
            bends = max(self.bends[length] - 1, 0.0)
            this, fast = self._way(length, moved, bends, noise)
            does = float(np.clip((clear - caution.told) / (caution.does - caution.told), 0, 1))
            told, rest = told + rest * does * this, rest * (1 - does)
            hides = min(caution.hidden + way.HIDES_AT_FAST * (way.FAST_HZ * count * dt * length) ** 2, way.MOST_HIDDEN)
            may = float(np.clip(clear / caution.told, 0, 1))
            most += rest_of_most * may * (this + fast * (hides - 1))
            rest_of_most *= 1 - may
            if length == 1:
                this, fast = self._way(length, moved + way.MAY * sure, bends + way.MAY * sure, noise)
                bound = this + fast * (hides - 1)
        return told, max(min(most, bound), told)

    @staticmethod
    def _way(length: int, moved: float, bends: float, noise: float) -> tuple[float, float]:
        of_change = moved * noise**2 / (2 * length)
        of_bend = way.BEND * min(bends * noise**2 * 3 / (2 * length), 4 * of_change)
        per_look = way.WAY / length
        return float(np.sqrt(of_change + of_bend)) * per_look, float(np.sqrt(way.FAST * of_bend)) * per_look

    def _compare(self, length: int, share: float, noise: float, largest: float) -> None:
        ends = (len(self.seen), len(self.seen) - length, len(self.seen) - 2 * length)
        newest, last, before = (np.mean(self.seen[end - length : end]) if end > 0 else 0.0 for end in ends)
        for order, change, variance in (
            (1, newest - last, noise**2 / (2 * length)),
            (2, newest - 2 * last + before, noise**2 * 3 / (2 * length)),
        ):
            size = min(abs(change) / np.sqrt(variance), largest / np.sqrt(variance) + variances.CLEAR) ** 2
            if order == 2:
                self.bends[length] = self._counted(self.bends[length], size, share)
                size = min(size, variances.MOST)
            for side in (1, -1):
                counts = size if side * change > 0 else 0.0
                self.sides[length, side, order] = self._counted(self.sides[length, side, order], counts, share)

    @staticmethod
    def _counted(before: float, size: float, share: float) -> float:
        return float(before + min((size - before) * share, variances.GROWS * max(before, 0.0) + variances.AT_ONCE))
