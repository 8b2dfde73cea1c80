"""Inertial data without fast changes: their approximation by wavelets, what the 2016 study calls de-noising.

Between gaps each axis keeps the approximation of its wavelet transform and loses all details: with Daubechies 4 at
level 7 what is faster than rate / 256 (.4 Hz at 100 Hz). Motion goes with the noise, and what is left is no longer
white: `scripts/reproduce_paper` shows what it does to positions. Source: Mallat (1989), A theory for multiresolution
signal decomposition, IEEE PAMI 11(7); the transform is that of PyWavelets.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.session import Session

OPTION = "--denoise"
GAP_STEPS = 3.0  # median intervals


@dataclass(frozen=True)
class Denoising:
    """wavelet : a discrete one of PyWavelets, as db4; level : of the approximation that is kept, >= 1"""

    wavelet: str = "db4"
    level: int = 7

    @classmethod
    def parse(cls, text: str) -> Denoising:
        """Of ``db4:7``, or of the name of a wavelet alone, at level 7.

        Raises
        ------
        ConfigError
            No such wavelet or level, or PyWavelets is not installed.
        """
        name, _, level = text.partition(":")
        try:
            found = cls(name, int(level or cls.level))
        except ValueError:
            found = cls(name, 0)
        if found.level < 1:
            raise ConfigError(OPTION, repr(text), "wavelet:level, as db4:7")
        try:
            import pywt
        except ImportError as error:
            remedy = 'pip install "smartnav-graph[reproduce]"'
            raise ConfigError(OPTION, "PyWavelets is not installed", "it", remedy) from error
        if name not in pywt.wavelist(kind="discrete"):
            raise ConfigError(OPTION, f"wavelet {name!r}", "a discrete wavelet of PyWavelets, as db4, sym5, haar")
        return found


def denoised(session: Session, how: Denoising) -> Session:
    """The session with the slow part of its inertial data; their count is among `dropped`.

    Raises
    ------
    SessionError
        A stretch between gaps is too short for the level.
    """
    import pywt

    imu = session.require_imu()
    steps = np.diff(imu.t_ns)
    ends = np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1
    least = (pywt.Wavelet(how.wavelet).dec_len - 1) << how.level
    stretches = np.split(np.arange(len(imu)), ends)
    short = min(stretches, key=len)
    if len(short) < least:
        found = f"{len(short)} inertial samples without gap at {session.seconds(imu.t_ns[short[:1]])[0]:.1f} s"
        expected = f"at least {least} for {how.wavelet} at level {how.level}"
        raise SessionError(session.path or "session", found, expected, f"lower the level of {OPTION}")

    def slow(readings: Floats) -> Floats:
        parts = pywt.wavedec(readings, how.wavelet, level=how.level, axis=0)
        kept = [parts[0], *(np.zeros_like(part) for part in parts[1:])]
        return np.asarray(pywt.waverec(kept, how.wavelet, axis=0)[: len(readings)])

    accel, gyro = (np.concatenate([slow(x[rows]) for rows in stretches]) for x in (imu.accel, imu.gyro))
    fastest = NS / float(np.median(steps)) / 2 ** (how.level + 1)
    reason = f"smoothed by {how.wavelet} at level {how.level}: motion faster than {fastest:.2g} Hz is removed, too"
    dropped = {**session.dropped, "imu": {**session.dropped.get("imu", {}), reason: len(imu)}}
    return session.replace(imu=replace(imu, accel=accel, gyro=gyro), dropped=dropped)
