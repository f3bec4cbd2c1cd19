"""XML files that describe robots (URDF, COLLADA), bounded before other libraries see them.

The parsers of urdfdom, Pinocchio and Assimp are recursive C++: a file of 400 kB whose links are
fixed to one another in a row, or whose elements are nested deeply, overflows the stack, which ends
the process. What is too deep or too large is refused here, by code that does not recurse.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from xml.etree import ElementTree
from xml.parsers import expat

from mtv_world_ros.core.bounded_input import check_limit, LimitError, limits, PREFIX

#: what the standard library raises for a text that is no XML
NO_XML = (ElementTree.ParseError, expat.ExpatError)


def parse_xml(text: str | bytes) -> ElementTree.Element:
    """Return the root of an XML text within the limits.

    Raises:
        ElementTree.ParseError, expat.ExpatError: it is no XML.
        ValueError: it has too many elements, is nested too deeply, or declares a document type,
            whose entities expand to texts of any length.
    """
    check_xml(text)
    return ElementTree.fromstring(text)


def check_xml(text: str | bytes) -> None:
    """Check that an XML text is well formed and within the limits; see `parse_xml`."""
    _Count().check(text)


class _Count:
    """Counter of the elements of an XML text and of their nesting."""

    def __init__(self) -> None:
        self._limits = limits()  # the environment is read once
        self._depth = self._num_elements = 0

    def check(self, text: str | bytes) -> None:
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._begin
        parser.EndElementHandler = self._end
        parser.StartDoctypeDeclHandler = self._refuse
        parser.Parse(text, True)

    def _begin(self, *_: object) -> None:
        self._depth += 1
        self._num_elements += 1
        if self._depth > self._limits.nesting:
            raise LimitError(
                f'it is nested in more than {self._limits.nesting} levels (the environment '
                f'variable {PREFIX}NESTING allows more)'
            )
        if self._num_elements > self._limits.xml_elements:
            check_limit('xml_elements', self._num_elements, 'it')

    def _end(self, _: str) -> None:
        self._depth -= 1

    def _refuse(self, name: str, *_: object) -> None:
        raise ValueError(f"it declares a document type ('<!DOCTYPE {name}'); remove that line")


def root_link(robot: ElementTree.Element) -> str:
    """Return the root of a URDF's links; they are a tree, with bounds on number and depth.

    Raises:
        ValueError: there is none; names the link, or the limit and how to raise it.
    """
    links = robot.findall('link')
    joints = robot.findall('joint')
    check_limit('urdf_links', max(len(links), len(joints)), 'the robot')
    parents = _parents(joints)
    children = defaultdict(list)
    for child, (parent, _) in parents.items():
        children[parent].append(child)
    level = [parent for parent in children if parent not in parents]
    num_reached = depth = 0
    while level:
        depth += 1
        check_limit('chain_links', depth, 'a chain of the robot')
        level = [child for parent in level for child in children[parent]]
        num_reached += len(level)
    if num_reached < len(parents):
        raise ValueError(
            f"links hang on each other in a circle, among them '{_in_circle(parents)}'; a URDF is "
            'a tree'
        )
    roots = [name for link in links if (name := link.get('name', '')) not in parents]
    if not roots:
        raise ValueError('it has no link')
    return roots[0]


def _parents(joints: list[ElementTree.Element]) -> dict[str, tuple[str, str]]:
    """Return each child link's parent link and joint; incomplete joints are left to the parser.

    Raises:
        ValueError: a link is the child of two joints, which the parsers accept, and then visit it
            once for each way there.
    """
    parents: dict[str, tuple[str, str]] = {}
    for joint in joints:
        parent, child = joint.find('parent'), joint.find('child')
        if parent is None or child is None:
            continue
        link, name = child.get('link', ''), joint.get('name', '')
        if link in parents:
            raise ValueError(
                f"link '{link}' is the child of two joints, '{parents[link][1]}' and '{name}'; a "
                'URDF is a tree'
            )
        parents[link] = parent.get('link', ''), name
    return parents


def _in_circle(parents: Mapping[str, tuple[str, str]]) -> str:
    """Return a link from which the way up to the root does not end."""
    good = set[str]()
    for link in parents:
        way = set[str]()
        while link in parents and link not in good:
            if link in way:
                return link
            way.add(link)
            link = parents[link][0]
        good |= way
    return ''
