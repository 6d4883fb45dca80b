"""Show: one run of one log as a Rerun recording (.rrd), the truth beside every configuration, a blueprint inside.

| entity | is |
|---|---|
| `world/truth/boxes`, `ego`, `paths`, `onsets` | the log; of the shown objects, ways, and places at their onsets |
| `world/truth/lanes` | boundaries of lanes, where the log has them |
| `world/static/obstacles`, `grid` | obstacles, and lines on the ground every 10 m |
| `world/units/<unit>`, `world/fields/<unit>` | units, and the fields of view of their PEMs |
| `world/<configuration>/boxes`, `covariance` | the receiver's fused tracks, paler the older; 2σ of where |
| `world/<configuration>/status`, `hiding`, `listings` | at each: known or why not; what hides it; its first unit |
| `world/<configuration>/marks`, `marks/from`, `marks/from/line` | where it was first known, and from how far away |
| `world/eyes/ego`, `world/eyes/<object>` | origins of the views that follow |
| `lanes/<object>/<place>_<configuration>` | how far it has come (`viewer/status.py`), a mark at the onset |
| `lists/<place>_<configuration>/<unit>` | lists that were lost, late or overtaken, of a unit that sends by a link |
| `plots/visible_share/<object>/…` | how much of it is seen by the ego's units, and by the best of all |
| `plots/visible_share/<object>/mark_1`, … | onset and detections on these curves |
| `plots/position_error/<object>/<configuration>` | fused to true position: running quartiles |
| `plots/gospa/<configuration>`, `plots/known/<configuration>` | over all measured objects: GOSPA, how many are known |
| `…/difference/…`, `plots/error_difference` | differences to a baseline (`viewer/differences.py`) |
| `legend/…` | the colour of each configuration |
| `events/onsets`, `events/<configuration>`, `…/lists`, `difference`, `summary`, `words` | in words |

`<object>` is `6_pedestrian`. Of more than six configurations there are further files (`viewer/selection.py`).

Columns are sent in slices of time, an entity holds all its objects: hundreds of entities slow the viewer down. It shows
the newest row of an entity until the next one, so an instant at which there is nothing has an empty row of its own.
"""

from copem_replay.viewer.rrd import write_rrd
from copem_replay.viewer.stream import VIEWER, check_viewer

__all__ = ["VIEWER", "check_viewer", "write_rrd"]
