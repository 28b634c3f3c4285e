"""Files: what enters the package from the outside, and what leaves it.

Enters: a FITS file with the frames of a sensor, `(plane, y, x)` or `(frame, plane, y, x)`, in electrons or
adu, with what the header says about the optics and the detector (`frames_fits`). Leaves: frames in the same
format, and a FITS file with the wavefront, its modes and its residual (`wavefront_fits`), each with its
`provenance` and written whole or not at all (`atomic_write`).

In every file row 0 is at the smallest y, which is how ds9 draws it; frames count from 0, and planes from 1 as
in `ZPLANE1`. What a file breaks is told in one line: `file: keyword or HDU: rule, got value`.
"""

from nlcwfs.interop.atomic_write import atomic_write, check_writable
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_fits import read_frames, write_frames
from nlcwfs.interop.provenance import Provenance, read_provenance, settings_digest
from nlcwfs.interop.wavefront_file import BAD_FRAME, NOT_RUN, FrameWavefront, WavefrontFile
from nlcwfs.interop.wavefront_fits import read_wavefront, write_wavefront

__all__ = [
    "BAD_FRAME",
    "NOT_RUN",
    "FrameWavefront",
    "FramesFile",
    "Provenance",
    "WavefrontFile",
    "atomic_write",
    "check_writable",
    "read_frames",
    "read_provenance",
    "read_wavefront",
    "settings_digest",
    "write_frames",
    "write_wavefront",
]
