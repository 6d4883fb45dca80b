"""Show: one run of one log as a Rerun recording (.rrd), the truth beside every configuration, a blueprint inside.

| entity | is |
|---|---|
| `world/truth/boxes`, `measured`, `paths`, `onsets` | the log; of what is measured name, path, place at its onset |
| `world/static`, `world/units/<unit>`, `world/fields/<unit>` | obstacles, units, and the fields of view of their PEMs |
| `world/sight/clear`, `hidden` | lines from the ego's first unit to what is measured, or to what hides it |
| `world/<configuration>/boxes`, `covariance`, `marks` | what the receiver believes, 2σ of where, where it first knew |
| `plots/visible_share/<object>/…` | how much of it is seen by the ego's units, and by the best of all |
| `plots/visible_share/<object>/mark 1`, … | onset and detections on these curves |
| `plots/position_error/<object>/<configuration>` | believed to true position at the instant the list is available |
| `plots/known/<configuration>`, `truth` | how many of the measured objects the newest list holds, and the log |
| `events/<configuration>`, `summary` | in words |
| `…/difference/…`, `plots/error_difference` | where configurations are compared with a baseline (`differences.py`) |

Columns are sent whole, an entity holds all its objects: hundreds of entities slow the viewer down. It shows the newest
row of an entity until the next one, so an instant at which there is nothing has an empty row of its own.
"""

from copem_replay.show.recording import write_rrd

__all__ = ["write_rrd"]
