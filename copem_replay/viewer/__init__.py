"""Viewer: one run of one log as a Rerun recording (.rrd) that holds truth, configurations and a blueprint.

| entity | what it shows |
|---|---|
| `world/truth/boxes`, `ego`, `paths`, `onsets` | the log; paths of the shown objects, and their places at the onsets |
| `world/truth/lanes` | boundaries of lanes, where the log has them |
| `world/static/obstacles`, `grid` | obstacles; lines on the ground every 10 m |
| `world/units/<unit>`, `world/fields/<unit>` | units, and the fields of view of their PEMs |
| `world/<configuration>/boxes`, `covariance` | the receiver's fused tracks, paler the older; 2σ of the position |
| `world/<configuration>/status`, `hiding`, `listings` | per object: known or why not; what hides it; its first unit |
| `world/<configuration>/status_near` | the same words as in `status`, placed for the views of one object |
| `world/<configuration>/marks`, `marks/from`, `marks/from/line` | where an object was first known, and how far away |
| `world/eyes/ego`, `world/eyes/<object>` | origins of the views that follow ego or object |
| `world/eyes/large` | the same of the scene with two configurations, where views of the overview are wide |
| `world/eyes/ego/arrows` | shown objects that are outside the picture around the ego |
| `world/eyes/ego/false/<configuration>` | where the nearest false entries are, in words or as arrows at the edge |
| `lanes/<object>/<place>_<configuration>` | the object's status (`viewer/status.py`), a mark at the onset |
| `lists/<place>_<configuration>/<unit>` | lost, late and overtaken lists of a unit that sends by a link |
| `world/<configuration>/needless` | what the driver brakes for who brakes for nothing, while he does |
| `world/<configuration>/false`, `second` | entries about nobody, crossed; second entries of somebody, thin |
| `plots/visible_share/<object>/…` | visible share from the ego's units, and the best of all; `…_outside`: out of view |
| `plots/visible_share/<object>/mark_1`, … | onset and detections on these curves |
| `plots/position_error/<object>/<configuration>` | fused to true position: running quartiles |
| `plots/gospa/<configuration>`, `plots/known/<configuration>` | of all measured objects: GOSPA, number known |
| `…/difference/…`, `plots/error_difference` | differences to a baseline (`viewer/curves.py`) |
| `recorded/<topic>`, `pose/<frame>` | images and points of the recording itself (`viewer/recorded.py`) |
| `legend/…` | the colour of each configuration |
| `events/onsets`, `events/<configuration>`, `…/lists`, `…/needless`, `…/false` | texts: what happens when |
| `difference`, `summary`, `words`, `false` | texts; `false`: the longest false tracks |
| `difference_short`, `helps/<object>` | what of the differences is in the overview; what would help with an object |

`<object>` is for example `6_pedestrian`. More than seven configurations go into several files (`viewer/sink.py`).

An entity holds all its objects, because hundreds of entities slow the viewer down. The viewer shows the newest row of
an entity until the next one, so an instant at which there is nothing to show has an empty row. Columns are sent in
slices of time, so that little is held in memory.
"""

from __future__ import annotations

from copem_replay.viewer.rrd import write_rrd, write_with_recording
from copem_replay.viewer.sink import VIEWER, check_viewer

__all__ = ["VIEWER", "check_viewer", "write_rrd", "write_with_recording"]
