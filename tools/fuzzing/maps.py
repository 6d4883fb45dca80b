"""Hostile maps of all formats for `fuzz.py`, hit in every way, read and added to a recording."""

from __future__ import annotations

import json
import random
import traceback
import warnings
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path
from typing import Any

from fuzzing.mutators import document_hit

ROOT = Path(__file__).resolve().parents[2]
_CUBIC = 'sOffset="0" a="3" b="0.01" c="-0.001" d="0.00001"'
_ROAD = f"""<OpenDRIVE><header><geoReference>+proj=utm +zone=32</geoReference><offset x="1" y="2" hdg="0.1"/></header>
<road id="7" length="90" junction="3" rule="LHT"><planView>
<geometry s="0" x="0" y="0" hdg="0.1" length="20"><line/></geometry>
<geometry s="20" x="20" y="2" hdg="0.1" length="20"><arc curvature="0.05"/></geometry>
<geometry s="40" x="38" y="8" hdg="1.1" length="20"><spiral curvStart="0.05" curvEnd="-0.02"/></geometry>
<geometry s="60" x="45" y="27" hdg="1.2" length="15"><poly3 a="0" b="0" c="0.01" d="0"/></geometry>
<geometry s="75" x="50" y="40" hdg="1.2" length="15"><paramPoly3 aU="0" bU="15" cU="0" dU="0" aV="0" bV="0" cV="2"
 dV="0" pRange="normalized"/></geometry></planView>
<elevationProfile><elevation s="0" a="0" b="0.01" c="0" d="0"/></elevationProfile>
<lateralProfile><superelevation s="0" a="0.02" b="0" c="0" d="0"/></lateralProfile>
<lanes><laneOffset s="0" a="0.5" b="0" c="0" d="0"/><laneSection s="0">
<left><lane id="1" type="driving"><width {_CUBIC}/></lane></left>
<right><lane id="-1" type="driving"><width {_CUBIC}/></lane>
<lane id="-2" type="biking"><border {_CUBIC}/></lane></right>
</laneSection></lanes><objects>
<object id="1" type="building" s="10" t="20" zOffset="0" hdg="0.3" length="10" width="6" height="8"/>
<object id="2" type="pole" s="10" t="12" zOffset="0" hdg="0" radius="0.2" height="8"/>
<object id="3" type="barrier" s="0" t="8" length="1" width="1" height="1"><repeat s="10" length="40" distance="0"
 tStart="8" tEnd="9" heightStart="1" heightEnd="2"/><repeat s="10" length="40" distance="5"/></object>
<object id="4" type="building" s="30" t="30" zOffset="0"><outlines><outline closed="true">
<cornerRoad s="25" t="20" dz="0" height="5"/><cornerRoad s="35" t="20" dz="0" height="5"/>
<cornerRoad s="35" t="30" dz="0" height="6"/></outline>
<outline closed="false"><cornerLocal u="1" v="1" z="0" height="2"/>
<cornerLocal u="9" v="1" z="0" height="2"/></outline></outlines></object>
<object id="5" type="crosswalk" s="50" t="0" length="4" width="8"/></objects></road></OpenDRIVE>"""


def _lanelets() -> str:
    places = [(x, y) for y in (0, 3, 6) for x in (0, 10, 20)]
    nodes = "".join(
        f'<node id="{k}" lat="{48 + y / 1e5}" lon="{11 + x / 1e5}"><tag k="local_x" v="{x}"/><tag k="local_y" v="{y}"/>'
        f'<tag k="ele" v="1"/></node>'
        for k, (x, y) in enumerate(places)
    )
    ways = "".join(
        f'<way id="{10 + n}">{"".join(f"""<nd ref="{3 * n + k}"/>""" for k in range(3))}</way>' for n in range(3)
    )
    ways += (
        '<way id="20"><nd ref="0"/><nd ref="2"/><nd ref="8"/><nd ref="6"/><tag k="type" v="intersection_area"/></way>'
    )
    ways += '<way id="21"><nd ref="0"/><nd ref="4"/><tag k="type" v="wall"/><tag k="height" v="3 m"/></way>'
    relations = "".join(
        f'<relation id="{30 + n}"><member type="way" role="left" ref="{11 + n}"/><member type="way" role="right" '
        f'ref="{10 + n}"/><tag k="type" v="lanelet"/><tag k="subtype" v="{kind}"/></relation>'
        for n, kind in enumerate(("road", "crosswalk"))
    )
    return f"<osm>{nodes}{ways}{relations}</osm>"


def _city() -> str:
    def line(*at: tuple[float, float]) -> list[dict[str, float]]:
        return [{"x": x, "y": y, "z": 1.0} for x, y in at]

    lane = {"lane_type": "VEHICLE", "is_intersection": False, "left_lane_boundary": line((0, 3), (20, 3)),
            "right_lane_boundary": line((0, 0), (9, 0), (20, 0))}  # fmt: skip
    crossing = {"edge1": line((5, 0), (5, 3)), "edge2": line((8, 0), (8, 3))}
    drivable = {"area_boundary": line((0, 0), (20, 0), (20, 9))}
    return json.dumps(
        {"lane_segments": {"1": lane}, "pedestrian_crossings": {"2": crossing}, "drivable_areas": {"3": drivable}}
    )


def _houses() -> str:
    """OpenStreetMap: a house with a hole of two ways, a part with levels, a wall, a roof."""
    at = [(0, 0), (20, 0), (20, 20), (0, 20), (5, 5), (10, 5), (10, 10), (30, 0)]
    nodes = "".join(f'<node id="{k}" lat="{48 + y / 1e5}" lon="{11 + x / 1e5}"/>' for k, (x, y) in enumerate(at))

    def way(ident: int, refs: tuple[int, ...], **tags: str) -> str:
        said = "".join(f'<tag k="{k.replace("_", ":")}" v="{v}"/>' for k, v in tags.items())
        return f'<way id="{ident}">{"".join(f"""<nd ref="{ref}"/>""" for ref in refs)}{said}</way>'

    ways = way(10, (0, 1, 2)) + way(11, (2, 3, 0)) + way(12, (4, 5, 6, 4))
    ways += way(13, (0, 1, 2, 0), building_part="yes", building_levels="3", min_height="2 m")
    ways += way(14, (3, 7), barrier="wall", height="12'6&quot;") + way(15, (0, 4, 7, 0), building="roof")
    members = "".join(
        f'<member type="way" ref="{ref}" role="{role}"/>' for ref, role in ((10, "outer"), (11, "outer"), (12, "inner"))
    )
    relation = f'<relation id="20">{members}<tag k="type" v="multipolygon"/><tag k="building" v="yes"/></relation>'
    return f"<osm>{nodes}{ways}{relation}</osm>"


def _features() -> str:
    ring = [[11.0, 48.0], [11.001, 48.0], [11.001, 48.001], [11.0, 48.0]]
    shapes = [
        {"type": "Polygon", "coordinates": [ring]}, {"type": "MultiPolygon", "coordinates": [[ring]]},
        {"type": "LineString", "coordinates": ring},
    ]  # fmt: skip
    said = {"building": "yes", "height": "7", "levels": 2, "min_height": 1, "barrier": "wall"}
    return json.dumps(
        {
            "type": "FeatureCollection",
            "features": [{"type": "Feature", "properties": said, "geometry": g} for g in shapes],
        }
    )


def _elements() -> str:
    nodes = [{"type": "node", "id": k, "lat": 48 + k % 2 / 1e4, "lon": 11 + k // 2 / 1e4} for k in range(4)]
    way = {"type": "way", "id": 9, "nodes": [0, 1, 3, 0], "tags": {"building": "yes", "building:levels": "2"}}
    members = [{"type": "way", "ref": 9, "role": "outer"}]
    relation = {"type": "relation", "id": 8, "members": members, "tags": {"type": "multipolygon", "building": "yes"}}
    return json.dumps({"elements": [*nodes, way, relation]})


SEEDS = {"map.xodr": _ROAD, "map.osm": _lanelets(), "map.json": _city(), "houses.osm": _houses(),
         "features.json": _features(), "elements.json": _elements()}  # fmt: skip
_VALUES = ("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "0", "-1", "1e7", "1e8", "99999999999999999999", "", "x",
           "\u0661", "1_0", " 3 ", "1e-9", "1e6", "-0", "0x10", "true", "LHT", "driving", "crosswalk")  # fmt: skip


def _xml_hit(data: bytes, dice: random.Random) -> bytes:
    """A tree with attributes, elements and references changed; rarely one that is deep, or has a million corners."""
    root = ET.fromstring(data)
    for _ in range(dice.choice((1, 1, 2, 5))):
        every = [(parent, child) for parent in root.iter() for child in parent]
        if not every:
            break
        parent, child = dice.choice(every)
        pick = dice.random()
        if pick < 0.55 and child.attrib:
            key = dice.choice(sorted(child.attrib))
            others = [value for _, other in every for value in other.attrib.values()]
            child.set(key, dice.choice((*_VALUES, dice.choice(others))))
        elif pick < 0.65 and child.attrib:
            del child.attrib[dice.choice(sorted(child.attrib))]
        elif pick < 0.75:
            parent.remove(child)
        elif pick < 0.85:
            parent.extend([child] * dice.choice((1, 3, 300)))
        elif pick < 0.93:
            dice.choice(every)[0].append(ET.fromstring(ET.tostring(child)))
        elif pick < 0.96:
            child.tag = dice.choice(every)[1].tag
        else:
            child.text = "x" * dice.choice((1, 100_000))
    text = ET.tostring(root)
    pick = dice.random()
    if pick < 0.005:
        depth = dice.choice((1_000, 100_000, 299_000, 400_000))
        text = text.replace(b"</road>", b"<a>" * depth + b"</a>" * depth + b"</road>", 1)
    elif pick < 0.01:
        many = dice.choice((1_000, 100_000, 250_000, 1_000_000))
        text = text.replace(b"</outline>", b'<cornerLocal u="1" v="2" z="0" height="1"/>' * many + b"</outline>", 1)
        text = text.replace(b"</way>", b'<nd ref="1"/>' * many + b"</way>", 1)
    elif pick < 0.02:
        text = text.replace(b'distance="5"', dice.choice((b'distance="1e-9"', b'distance="0.002"', b'distance="-1"')))
        text = text.replace(b'length="40"', dice.choice((b'length="1e6"', b'length="1e8"', b'length="-5"')))
    return text


def put_map(seed: str, folder: Path) -> tuple[Path, str]:
    """The hostile map of a seed, and what it was made of."""
    dice = random.Random(seed)
    name = dice.choice(sorted(SEEDS))
    data = SEEDS[name].encode()
    is_json = name.endswith(".json")
    if dice.random() < 0.5 and not is_json:
        data = _xml_hit(data, dice)
    elif is_json and dice.random() < 0.01:
        data = b'{"a":' * dice.choice((500, 100_000)) + b"1"
    elif is_json and dice.random() < 0.005:
        points = ",".join(['{"x":1,"y":2}'] * dice.choice((100_000, 1_000_000)))
        data = f'{{"drivable_areas":{{"1":{{"area_boundary":[{points}]}}}}}}'.encode()
    else:
        data = document_hit(name if is_json else "map.xml", data, dice)
    path = folder / name
    path.write_bytes(data)
    return path, name


@cache
def _recording() -> Any:
    from copem_replay.io.recording import read_log

    return read_log(ROOT / "logs/tc016d.mcap", name="log")


def outcome_of_map(path: Path) -> dict[str, Any]:
    """What becomes of a map: it is read and added to a recording, or refused in single lines.

    It is added as if in the frame of the log, and by its own reference to a log at 48° N, 11° E.
    """
    ends, said = set[str](), list[str]()
    for same in (True, False):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                end, lines = _add_map(path, same=same)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            ours = [f for f in traceback.extract_tb(error.__traceback__) if "copem_replay" in f.filename]
            where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "?"
            return {"outcome": "defect", "what": f"{type(error).__name__} at {where}: {str(error)[:200]}"}
        ends.add(end)
        said += lines
    for line in said:
        if len(line.splitlines()) > 1 or not all(c.isprintable() for c in line):
            return {"outcome": "defect", "what": f"not one printable line: {line[:150]!r}"}
    end = "read" if "read" in ends else "refused"
    return {"outcome": end, "said": said, "past": end == "read"}


def _add_map(path: Path, *, same: bool) -> tuple[str, list[str]]:
    """Whether a map is read, and the lines that are said of it."""
    from pydantic import ValidationError

    from copem_replay.core.errors import InputError
    from copem_replay.core.frame import Frame, make_local_proj
    from copem_replay.experiment.maps import MapFile, add_maps
    from copem_replay.metrics.agreement import estimate_shift

    recording, frame = _recording(), Frame(make_local_proj(48.0, 11.0))
    asked = {"file": str(path), "agreement": "ignore"} | ({"frame": "same"} if same else {})
    try:
        a_map = MapFile.model_validate(asked)
        added, problems = add_maps(recording, [a_map], frame)
        lanes = a_map.place(frame).lanes
    except ValidationError as error:
        return "refused", [str(one["msg"]) for one in error.errors()]
    except InputError as error:
        return "refused", error.problems
    estimate_shift(recording.scene, recording.truth, lanes)
    return "read", [*added.notes, *(line for _, line in problems)]
