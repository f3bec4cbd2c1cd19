"""The fault catalogue: what can be wrong with a scripted policy, and its sizes.

`faulty_way_points.py`, `faulty_commands.py` and `glitches.py` carry it out.

A policy's name says its faults and their sizes: `expert-noise-0.02`, `expert-high-0.03-late-0.3`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
import re

import numpy as np

from mtv_world_ros.errors import nearest, PolicyError

EXPERT = 'expert'
#: of fault kinds; kinds of `test` never enter training, calibration or the choice of anything
SPLITS = ('train', 'calibrate', 'test')


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultKind:
    """One way in which a policy fails.

    Attributes:
        family: what it is an error of.
        split: `train`, `calibrate` or `test`.
        typical: a size at which success and failure are about as frequent.
        largest: largest size.
        unit: of the size.
        text: what the size means.
        none: the size at which there is no fault.
        contact: whether its failures are failures of contact, which do not show in the arm's path
            alone.
    """

    family: str
    split: str
    typical: float
    largest: float
    unit: str
    text: str
    none: float = 0.0
    contact: bool = True


def _kind(
    family: str,
    split: str,
    typical: float,
    largest: float,
    unit: str,
    text: str,
    *,
    contact: bool = True,
) -> FaultKind:
    return FaultKind(
        family=family,
        split=split,
        typical=typical,
        largest=largest,
        unit=unit,
        text=text,
        contact=contact,
    )


FAULTS: Mapping[str, FaultKind] = {
    'noise': _kind(
        'speed', 'train', 0.04, 0.5, 'rad', 'standard deviation of a slow error of every joint'
    ),
    'miss': _kind(
        'lateral', 'train', 1, 1.0, '', 'probability of a grasp that closes beside its object'
    ),
    # timing
    'late': _kind('timing', 'train', 0.6, 3.0, 's', 'the grippers follow this much later'),
    'early': _kind('timing', 'train', 0.5, 2.0, 's', 'the grippers go this much ahead'),
    'hasty': _kind('timing', 'train', 0.03, 0.1, 'm', 'it rises this far while the fingers close'),
    'snap': _kind(
        'timing', 'train', 0.045, 0.09, 'm', 'the fingers close over the last part of the way down'
    ),
    'soft': _kind(
        'timing', 'train', 0.6, 1.5, 's', 'time constant with which the grippers follow'
    ),
    'hang': _kind('timing', 'calibrate', 0.8, 2.0, 's', 'the gripper opens this much later'),
    'loop': _kind('timing', 'train', 2.0, 4.0, 's', 'commands of this length are repeated once'),
    'skip': _kind('timing', 'train', 1.4, 3.0, 's', 'commands of this length are left out'),
    'ragged': _kind('timing', 'calibrate', 0.3, 2.0, 's', 'each arm joint is late, by up to this'),
    'seams': _kind(
        'timing',
        'calibrate',
        0.8,
        2.0,
        's',
        'every chunk of commands is up to this long off its time',
    ),
    'shuffle': _kind(
        'timing',
        'calibrate',
        0.8,
        2.0,
        's',
        'two chunks of commands of this length are carried out in the wrong order, once',
    ),
    'offbeat': _kind(
        'timing',
        'calibrate',
        0.4,
        1.0,
        '',
        'share by which the grippers are faster or slower than the arms, at most',
    ),
    'swoop': _kind(
        'timing',
        'train',
        0.36,
        0.5,
        'm',
        'it passes its object on a way of up to this length, and the fingers close as it goes',
    ),
    'flinch': _kind(
        'timing',
        'calibrate',
        0.5,
        2.0,
        's',
        'once, as a gripper opens or closes, the arms go back this long on their way, and return',
    ),
    'blur': _kind(
        'timing',
        'calibrate',
        1.0,
        3.0,
        's',
        'all commands are the mean of those of now and of a while ago, up to this long',
    ),
    'lapse': _kind(
        'timing',
        'train',
        0.35,
        2.0,
        's',
        'steps of the arms over this time are lost, once, and never made up for',
    ),
    'restart': _kind(
        'timing',
        'calibrate',
        0.9,
        1.0,
        '',
        'share of the plan up to which it starts all over, once',
    ),
    # height
    'high': _kind('height', 'train', 0.02, 0.1, 'm', 'a grasp closes this much too high'),
    'dive': _kind(
        'height', 'train', 1.0, 1.0, '', 'share that lacks of its height before it goes down'
    ),
    'drop_high': _kind('height', 'calibrate', 0.04, 0.15, 'm', 'it lets go this much too high'),
    'drag': _kind(
        'height',
        'train',
        0.75,
        1.0,
        '',
        'share of the way to its goal over which it drags the object before it lifts it',
    ),
    'thump': _kind(
        'height',
        'calibrate',
        0.035,
        0.06,
        'm',
        'what it holds is thumped on its goal, three times, this deep',
    ),
    'dip': _kind(
        'height',
        'calibrate',
        0.02,
        0.08,
        'm',
        'half-way to its goal, what it holds is dipped on the table, this deep',
    ),
    'sag': _kind(
        'height',
        'calibrate',
        0.35,
        0.5,
        '',
        'share of how far it reaches out by which the arm hangs too low',
    ),
    'droop': _kind(
        'height',
        'train',
        0.45,
        1.0,
        '',
        'share of how far it has carried the object by which the arm hangs too low',
    ),
    'slump': _kind(
        'height',
        'train',
        0.1,
        0.3,
        'm',
        'once, the arms give way under their weight, sink this far, and rise again',
    ),
    'heave': _kind(
        'height',
        'calibrate',
        0.04,
        0.1,
        'm',
        'both arms go up and down in waves, this far',
    ),
    # lateral
    'shift': _kind(
        'lateral',
        'train',
        0.015,
        0.1,
        'm',
        'standard deviation, in x and y, of where objects are seen',
    ),
    'aside': _kind('lateral', 'train', 0.025, 0.08, 'm', 'a grasp is shifted across the fingers'),
    'along': _kind(
        'lateral', 'calibrate', 0.015, 0.08, 'm', "a grasp is shifted along the fingers' travel"
    ),
    'slide': _kind(
        'lateral',
        'train',
        0.02,
        0.08,
        'm',
        "it comes down this far off along the fingers' travel and moves in while they close",
    ),
    'wander': _kind(
        'lateral', 'train', 0.015, 0.08, 'm', 'standard deviation of every way point, in x, y, z'
    ),
    'askew': _kind(
        'lateral', 'calibrate', 0.12, 0.3, 'rad', 'all places are turned about where the arm rests'
    ),
    'fence': _kind(
        'lateral',
        'train',
        0.17,
        0.6,
        '',
        'share that lacks of how far the arm reaches from where it rests; it stops there',
    ),
    'slope': _kind(
        'lateral',
        'train',
        0.8,
        2.0,
        '',
        'share of its height over the grasp by which a place is off, to one side',
    ),
    'stretch': _kind(
        'lateral',
        'calibrate',
        0.15,
        0.3,
        '',
        'share by which all places are farther from where the arm rests, or nearer to there',
    ),
    'hunt': _kind(
        'lateral',
        'train',
        0.04,
        0.1,
        'm',
        'on its way down, it swings from side to side with open fingers, this far',
    ),
    'grid': _kind(
        'lateral',
        'calibrate',
        0.05,
        0.15,
        'm',
        'all places are those of a grid in the plane with cells of this width',
    ),
    # wrist
    'turn': _kind('wrist', 'train', 0.8, 1.6, 'rad', 'the wrist is turned about the vertical'),
    'lean': _kind('wrist', 'train', 0.4, 0.9, 'rad', 'the wrist leans in a grasp'),
    'scoop': _kind(
        'wrist', 'train', 0.6, 0.9, 'rad', 'it comes down leaning, upright as the fingers close'
    ),
    'limp': _kind(
        'wrist',
        'calibrate',
        0.2,
        1.0,
        's',
        'time constant with which the joints of the wrist follow',
    ),
    'nod': _kind(
        'wrist',
        'calibrate',
        0.5,
        0.6,
        'rad',
        'down at the object, it leans to and fro, up to this far, before the fingers close',
    ),
    'rock': _kind(
        'wrist',
        'train',
        0.45,
        0.6,
        'rad',
        'what it holds leans to and fro on its goal, up to this far, before it is let go',
    ),
    'list': _kind(
        'wrist',
        'train',
        0.65,
        0.9,
        'rad',
        'how far the wrist leans where its arm reaches out most; less where it reaches less far',
    ),
    'flap': _kind(
        'wrist',
        'test',
        0.8,
        0.9,
        'rad',
        'having let go, the wrist leans to and fro where it is, four times, up to this far',
    ),
    # opening
    'loose': _kind(
        'opening', 'train', 0.4, 1.0, '', 'share of its range that the gripper stays open'
    ),
    'fumble': _kind(
        'opening',
        'train',
        0.3,
        1.0,
        '',
        'standard deviation of a slow error of how far the grippers open, as a share',
    ),
    'grip': _kind(
        'opening',
        'train',
        0.6,
        1.0,
        '',
        'standard deviation of how far the gripper is open at every way point, as a share',
    ),
    'narrow': _kind(
        'opening',
        'train',
        0.5,
        1.0,
        '',
        'share of its opening that lacks before a grasp; 1 = shut',
    ),
    'twitch': _kind(
        'opening',
        'calibrate',
        0.3,
        1.0,
        '',
        'again and again the gripper jerks open, to this share',
    ),
    'starve': _kind(
        'opening',
        'train',
        0.5,
        1.0,
        '',
        'the gripper gives way as its arm moves, by up to this share of its range',
    ),
    'splay': _kind(
        'opening',
        'train',
        0.8,
        1.0,
        '',
        'shut fingers come down beside the object and open there, to this share',
    ),
    'chatter': _kind(
        'opening',
        'train',
        0.45,
        2.0,
        's',
        'whenever a gripper opens or closes, it flickers to and fro for this long',
    ),
    'falter': _kind(
        'opening',
        'calibrate',
        0.9,
        2.0,
        's',
        'whenever a gripper opens or closes, it stands still half-way for this long',
    ),
    'leak': _kind(
        'opening',
        'calibrate',
        0.4,
        1.0,
        '1/s',
        'share of its range by which a shut gripper opens a second',
    ),
    'taut': _kind(
        'opening',
        'train',
        0.58,
        1.0,
        '',
        'the gripper gives way as its arm reaches out, by up to this share of its range',
    ),
    'yawn': _kind(
        'opening',
        'calibrate',
        0.45,
        1.0,
        '',
        'share of its way down that it comes shut; the fingers open over the rest',
    ),
    # release
    'drops': _kind(
        'release', 'train', 0.5, 1.0, '', 'share of the way to the goal that it is dropped before'
    ),
    'slack': _kind(
        'release',
        'calibrate',
        0.4,
        1.0,
        '',
        'share of its range that the gripper opens on the way',
    ),
    'snag': _kind('release', 'train', 0.8, 1.0, '', 'share that lacks of how far it lets go'),
    'flick': _kind(
        'release', 'train', 0.08, 0.15, 'm', 'it goes this far sideways while the fingers open'
    ),
    'blink': _kind(
        'release', 'calibrate', 0.2, 3.0, 's', 'the gripper opens and closes again, once lifted'
    ),
    'jiggle': _kind(
        'release',
        'train',
        0.04,
        0.1,
        'm',
        'having let go, it shakes its fingers to and fro, this far',
    ),
    'gnaw': _kind(
        'release',
        'train',
        0.06,
        0.12,
        'm',
        'having let go, it closes three times on its way aside, this far',
    ),
    'lob': _kind(
        'release',
        'calibrate',
        0.05,
        0.2,
        'm',
        'it swings what it holds this far, over its goal, and lets go in full swing',
    ),
    'bowl': _kind(
        'release',
        'calibrate',
        0.06,
        0.15,
        'm',
        'what it holds slides this far to its goal, in one stroke, while the fingers open',
    ),
    'shed': _kind(
        'release',
        'test',
        0.03,
        0.12,
        'm',
        'it rises with what it holds, and opens as it shakes it off, this far to either side',
    ),
    # collision
    'push': _kind(
        'collision', 'train', 0.04, 0.15, 'm', 'it comes in low from the side, from this far'
    ),
    'play': _kind(
        'collision',
        'train',
        2,
        6,
        '',
        'number of way points drawn at random: about the object, or where the gripper is',
    ),
    'odd': _kind(
        'any',
        'train',
        3,
        8,
        '',
        'number of runs of one to three way points with another opening, place or turn, or a '
        'detour, drawn at random',
    ),
    'glitch': _kind(
        'any',
        'train',
        3,
        12,
        '',
        'number of glitches of the commands drawn at random: grippers that jerk, joints that are '
        'off or swing, time that stands, jumps or runs, an arm at rest that moves along',
    ),
    'visit': _kind(
        'collision',
        'train',
        1,
        4,
        '',
        'number of visits to any object of the scene, through it or past it, drawn at random: '
        'when, from where, how low, open or shut, turned and leaning',
    ),
    'fidget': _kind(
        'collision',
        'train',
        5,
        12,
        '',
        'number of things done one after the other at any object, drawn at random: open or close, '
        'rise or sink, lean, turn, go aside',
    ),
    'tinker': _kind(
        'collision',
        'train',
        4,
        12,
        '',
        'number of things done one after the other with what it holds, drawn at random: press it '
        'down, drag, lean or turn it, put it on any object or where that lies, let it go, take it',
    ),
    'meet': _kind(
        'collision',
        'train',
        1,
        4,
        '',
        'number of times that what is held is carried low through the place of another object, or '
        'past it, drawn at random: when, which, from where, how low',
    ),
    'knock': _kind(
        'collision', 'train', 0.02, 0.1, 'm', 'shut fingers push what is at the goal before it'
    ),
    'brush': _kind(
        'collision', 'train', 0.04, 0.1, 'm', 'it goes this far sideways before it rises again'
    ),
    'low_carry': _kind('collision', 'calibrate', 0.04, 0.15, 'm', 'it carries this much lower'),
    'sweep': _kind(
        'collision', 'train', 0.02, 0.1, 'm', 'shut fingers push the object before the grasp'
    ),
    'cut': _kind(
        'collision',
        'train',
        0.1,
        0.2,
        'm',
        'it comes down this far before its goal, and slides in from there',
    ),
    'mirror': _kind(
        'collision',
        'calibrate',
        1.0,
        1.2,
        '',
        "an arm at rest mirrors this share of the other's motion",
    ),
    'stir': _kind(
        'collision', 'calibrate', 0.03, 0.08, 'm', 'it circles this wide before the fingers close'
    ),
    'herd': _kind(
        'collision',
        'train',
        0.06,
        0.1,
        'm',
        'shut fingers push the object this far along, and it is grasped where it should be then',
    ),
    'rub': _kind(
        'collision',
        'train',
        0.09,
        0.12,
        'm',
        'once done, shut fingers come back down onto the object and drag it this far',
    ),
    'crowd': _kind(
        'collision',
        'train',
        0.9,
        1.0,
        '',
        'share of the way that the other arm comes to where the object is let go',
    ),
    'rival': _kind(
        'collision',
        'calibrate',
        0.9,
        1.0,
        '',
        'share of the way that the other arm comes to where an object is grasped',
    ),
    'putt': _kind(
        'collision',
        'train',
        0.04,
        0.1,
        'm',
        'it lets go this far before its goal, and shut fingers push the object on',
    ),
    'grind': _kind(
        'collision',
        'train',
        0.09,
        0.12,
        'm',
        'what it holds is pressed on its goal and rubbed to and fro there, this far',
    ),
    'paw': _kind(
        'collision',
        'train',
        0.05,
        0.12,
        'm',
        'shut fingers press on the object and drag it this far; it is grasped where it was',
    ),
    'rake': _kind(
        'collision',
        'train',
        0.07,
        0.12,
        'm',
        'open fingers go this far towards the goal with the object between them, then close',
    ),
    'smear': _kind(
        'collision',
        'calibrate',
        0.04,
        0.1,
        'm',
        'it lets go this far before its goal; shut fingers press on the object and drag it on',
    ),
    'swirl': _kind(
        'collision',
        'calibrate',
        0.045,
        0.07,
        'm',
        'shut fingers go round the object and come this much nearer to it',
    ),
    'peck': _kind(
        'collision',
        'train',
        0.025,
        0.05,
        'm',
        'shut fingers peck at the object from above, off its middle, this deep',
    ),
    'haul': _kind(
        'collision',
        'train',
        0.04,
        0.12,
        'm',
        'shut fingers press on the object and drag it this far, and it is grasped there',
    ),
    'crank': _kind(
        'collision',
        'train',
        2.2,
        2.5,
        'rad',
        'shut fingers press on the object, off its middle, and go round that by this angle',
    ),
    'tug': _kind(
        'collision',
        'calibrate',
        0.04,
        0.12,
        'm',
        'over the goal, the other arm closes on what this one holds, and pulls it this far',
    ),
    'vise': _kind(
        'collision',
        'train',
        0.02,
        0.06,
        'm',
        'the shut hands of both arms first squeeze the object from either side, this deep',
    ),
    'slap': _kind(
        'collision',
        'calibrate',
        0.05,
        0.12,
        'm',
        'over the goal, the other arm hits what this one holds in one quick stroke, this far',
    ),
    'roam': _kind(
        'collision',
        'train',
        2,
        6,
        '',
        'number of places near objects that the other arm roams through meanwhile, low and open',
    ),
    'dribble': _kind(
        'collision',
        'train',
        0.04,
        0.12,
        'm',
        'before the grasp, shut fingers push the object this far, and back from its other side',
    ),
    'tail': _kind(
        'collision',
        'calibrate',
        0.8,
        1.0,
        '',
        'share of its way to the same places by which the other arm follows this one',
    ),
    'hinder': _kind(
        'collision',
        'test',
        0.85,
        1.0,
        '',
        "share of its way to half-way of this arm's by which the other arm stands in its way",
    ),
    # object and place
    'wrong': _kind(
        'object', 'train', 1, 1.0, '', 'probability that another object is taken', contact=False
    ),
    'torn': _kind(
        'object', 'train', 0.1, 0.5, '', 'share of the way to the next object that a grasp is off'
    ),
    'meddle': _kind(
        'object',
        'calibrate',
        0.04,
        0.12,
        'm',
        'once done, it takes what it has put the object on or beside, and moves it this far',
    ),
    'decoy': _kind(
        'object',
        'train',
        0.04,
        0.12,
        'm',
        'it first takes the other object next to its own, moves it this far and lets it go',
    ),
    'jostle': _kind(
        'object',
        'train',
        0.07,
        0.12,
        'm',
        'once done, shut fingers push what it has put the object on or beside, this far',
    ),
    'poach': _kind(
        'object',
        'train',
        0.08,
        0.12,
        'm',
        'once it is done, the other arm takes what it put there, and lets it fall this far away',
    ),
    'waver': _kind(
        'object',
        'train',
        0.9,
        1.0,
        '',
        'share of the way to the next object that it goes, down at its own, and comes back',
    ),
    'budge': _kind(
        'object',
        'train',
        0.015,
        0.12,
        'm',
        'meanwhile the other arm takes what is next to the goal and moves it this far',
    ),
    'rattle': _kind(
        'object',
        'train',
        0.08,
        0.1,
        'm',
        'once done, it closes on what it has put the object on or beside, and shakes it, this far',
    ),
    'yank': _kind(
        'object',
        'test',
        0.1,
        0.15,
        'm',
        'once done, it closes on what it has put the object on or beside, and yanks it this far',
    ),
    'heap': _kind(
        'object',
        'test',
        0.02,
        0.06,
        'm',
        'it first puts the other object next to its own on top of that, this far off its middle',
    ),
    'place': _kind(
        'place',
        'train',
        0.03,
        0.1,
        'm',
        'standard deviation, in x and y, of where it is put down',
        contact=False,
    ),
    'elsewhere': _kind(
        'place', 'train', 0.05, 0.15, 'm', 'it is put down this far off', contact=False
    ),
    # speed
    'slow': _kind(
        'speed', 'train', 0.25, 3.0, '', 'it takes this share longer and is cut off', contact=False
    ),
    'stop': FaultKind(
        family='speed',
        split='train',
        typical=0.5,
        largest=1.0,
        unit='',
        text='share of the plan after which the arms stand still; 0 = they never move',
        none=1.0,
        contact=False,
    ),
    'fast': _kind('speed', 'calibrate', 1, 3.0, '', 'it is this share faster'),
    'freeze': _kind(
        'speed', 'calibrate', 0.9, 3.0, 's', 'commands of this length are lost, three times'
    ),
    'stall': _kind(
        'speed', 'train', 0.8, 3.0, 's', 'the arms stand still for a while, the grippers do not'
    ),
    'smooth': _kind(
        'speed', 'calibrate', 1.5, 3.0, 's', 'the commands of the arms are averaged over this long'
    ),
    'spike': _kind(
        'speed',
        'calibrate',
        0.3,
        1.0,
        'rad',
        'standard deviation of short outliers of every joint',
    ),
    'choppy': _kind(
        'speed', 'calibrate', 0.6, 2.0, 's', 'it gets a command this seldom, and jumps to it'
    ),
    'ring': _kind(
        'speed',
        'calibrate',
        0.9,
        3.0,
        's',
        'period with which the arms swing about their commands',
    ),
    'sluggish': _kind(
        'speed',
        'calibrate',
        0.67,
        0.95,
        '',
        'share that lacks of the top speed of every arm joint; the grippers are in time',
    ),
    'waggle': _kind(
        'speed',
        'train',
        0.1,
        0.12,
        'm',
        'once lifted, it waves what it holds to and fro, this far',
    ),
    'hurl': _kind(
        'speed',
        'calibrate',
        5,
        9.0,
        '',
        'all is this share faster for as long as a gripper is shut',
    ),
    'swat': _kind(
        'speed',
        'train',
        0.01,
        0.1,
        'm',
        'shut fingers hit the object in one quick stroke, this far',
    ),
    'kick': _kind(
        'speed',
        'train',
        0.06,
        0.3,
        'rad',
        'standard deviation of how far an arm jerks as its gripper opens or closes',
    ),
    # joint
    'zero': _kind(
        'joint',
        'calibrate',
        0.04,
        0.2,
        'rad',
        'standard deviation of a constant error of every joint',
    ),
    'weak': _kind(
        'joint', 'calibrate', 0.25, 0.5, '', 'share that lacks of the travel of one joint'
    ),
    'tremble': _kind(
        'joint', 'calibrate', 0.03, 0.3, 'rad', 'amplitude of a fast oscillation of every joint'
    ),
    'swap': _kind(
        'joint',
        'calibrate',
        0.4,
        1.0,
        '',
        "share that the arms take of each other's commands, once",
    ),
    'couple': _kind(
        'joint',
        'calibrate',
        0.1,
        0.3,
        'rad',
        'standard deviation of how far each joint of an arm goes along as its gripper closes',
    ),
    'coarse': _kind(
        'joint', 'calibrate', 0.12, 0.4, 'rad', 'every arm joint knows only multiples of this'
    ),
    'lash': _kind('joint', 'calibrate', 0.09, 0.4, 'rad', 'play of every arm joint'),
    'brake': _kind(
        'joint',
        'calibrate',
        3.0,
        5.0,
        's',
        'one joint stands still for this long, the others do not',
    ),
    'ratchet': _kind(
        'joint',
        'calibrate',
        0.1,
        0.5,
        '',
        'share that every joint loses of the way that it turns to one side',
    ),
    'clamp': _kind(
        'joint',
        'calibrate',
        0.2,
        0.6,
        '',
        'share that lacks at both ends of the travel of one joint, which stops there',
    ),
    'tow': _kind(
        'joint',
        'train',
        0.12,
        0.5,
        '',
        'share of its motion by which every joint takes along the next one of its arm',
    ),
    'cog': _kind(
        'joint',
        'calibrate',
        0.15,
        0.5,
        'rad',
        'one joint skips by this, once, and is off from there on',
    ),
    'bind': _kind(
        'joint',
        'calibrate',
        0.3,
        1.0,
        'rad',
        'one joint sticks at one place until its command is this far on, and jumps there',
    ),
    'drift': _kind(
        'joint',
        'calibrate',
        0.014,
        0.2,
        'rad/s',
        'standard deviation of how fast every arm joint drifts off',
    ),
    'warp': _kind(
        'joint',
        'calibrate',
        0.05,
        0.5,
        'rad',
        'every arm joint is off by a wave over its angle, with this amplitude',
    ),
    'wane': _kind(
        'joint',
        'calibrate',
        0.2,
        0.5,
        '',
        'share that all arm joints lack of their travel at the end; at first they lack none',
    ),
    'stick': _kind(
        'joint',
        'test',
        0.06,
        0.4,
        'rad',
        'every arm joint stands until its command is this far off, and jumps there',
    ),
    # regrasp
    'retry': _kind(
        'regrasp', 'train', 0.03, 0.08, 'm', 'a first grasp is this far off, the second is right'
    ),
    'regrasp': _kind(
        'regrasp',
        'train',
        0.02,
        0.1,
        'm',
        'it puts the object down this far off and grasps where it was',
    ),
    'clutch': _kind(
        'regrasp',
        'train',
        0.8,
        1.0,
        '',
        'share by which the fingers close again while it retreats',
    ),
    'juggle': _kind(
        'regrasp',
        'train',
        0.08,
        0.15,
        'm',
        'half-way it lets the object fall from this height, and takes it again',
    ),
    'topple': _kind(
        'regrasp',
        'train',
        1.0,
        1.1,
        'rad',
        'it raises the object, lets it fall leaning by this much, and grasps where it was',
    ),
    'undo': _kind(
        'regrasp',
        'calibrate',
        0.05,
        0.15,
        'm',
        'it takes the object again and carries it back this far',
    ),
    'tidy': _kind(
        'regrasp',
        'train',
        0.05,
        0.1,
        'm',
        'once done, shut fingers push the object this far, off its middle',
    ),
    'perch': _kind(
        'regrasp',
        'train',
        0.05,
        0.08,
        'm',
        'it puts the object on another one, this far off its middle, and takes it again',
    ),
    'nibble': _kind(
        'regrasp',
        'train',
        0.06,
        0.1,
        'm',
        'it comes down this far off and closes three times on its way to the right place',
    ),
    'toss': _kind(
        'regrasp',
        'calibrate',
        0.035,
        0.1,
        'm',
        'it tosses the object this far aside, and takes it from where it let go',
    ),
    'hop': _kind(
        'regrasp',
        'train',
        0.018,
        0.05,
        'm',
        'on its way it puts the object down twice, lets go, and takes it again this far off',
    ),
    'jumble': _kind(
        'any', 'calibrate', 2, 4, '', 'number of way points that change places with the next one'
    ),
    # any; the last one, as the others look for way points by their phase
    'omit': _kind('any', 'train', 2, 4, '', 'number of way points that are left out'),
}


def kinds_named(text: str) -> tuple[str, ...]:
    """Returns the fault kinds of a split, or of a comma-separated list.

    Raises:
        PolicyError: no such split or kind; the text names the nearest known one.
    """
    names = tuple(name.strip() for name in text.split(',') if name.strip())
    if not names or names[0] in SPLITS:
        return kinds_of(text.strip())
    for name in names:
        if name not in FAULTS:
            raise PolicyError(
                f"unknown fault kind '{name}'{nearest(name, FAULTS)}; known are the splits "
                f'{", ".join(SPLITS)} and the kinds {", ".join(FAULTS)}'
            )
    return names


def kinds_of(split: str) -> tuple[str, ...]:
    """Returns the fault kinds of a split.

    Raises:
        PolicyError: no such split.
    """
    if split not in SPLITS:
        raise PolicyError(
            f"unknown split of fault kinds '{split}'{nearest(split, SPLITS)}; known are "
            f'{", ".join(SPLITS)}'
        )
    return tuple(name for name, kind in FAULTS.items() if kind.split == split)


@dataclass(frozen=True, slots=True)
class PolicyVariant:
    """The expert's faults; none is the expert.

    Attributes:
        sizes: (kind, size), each kind once, in the catalogue's order.
    """

    sizes: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        for fault, value in self.sizes:
            largest = FAULTS[fault].largest
            if not (isfinite(value) and 0 <= value <= largest):
                raise PolicyError(
                    f"policy fault '{fault}' is {value}; it must be 0 to {largest:g}"
                )

    @classmethod
    def of(cls, sizes: Mapping[str, float]) -> PolicyVariant:
        """Returns the variant of sizes by kind; kinds whose size means no fault are left out."""
        return cls(
            tuple(
                (kind, float(sizes[kind]))
                for kind, fault in FAULTS.items()
                if kind in sizes and sizes[kind] != fault.none
            )
        )

    def size(self, kind: str) -> float:
        """Returns the size of one fault."""
        return dict(self.sizes).get(kind, FAULTS[kind].none)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of its faults."""
        return tuple(kind for kind, _ in self.sizes)

    @property
    def name(self) -> str:
        """The name that `parse_variant` reads."""
        return '-'.join([EXPERT, *(f'{kind}-{size:g}' for kind, size in self.sizes)])


def parse_variant(text: str) -> PolicyVariant:
    """Returns the variant of a name: `expert`, then any of its faults, each with its size.

    Raises:
        PolicyError: no such name, a fault twice or without a size, a size out of range.
    """
    name = text.strip()
    if not re.fullmatch(rf'{EXPERT}(-[a-z_]+-\d*\.?\d+)*', name):
        raise PolicyError(
            f"'{text}' is no scripted policy{_near(name)}; they are called '{EXPERT}', followed "
            f"by faults with their sizes, like '{EXPERT}-noise-0.02' or "
            f"'{EXPERT}-late-0.3-miss-0.5'; faults are {', '.join(FAULTS)}"
        )
    sizes: dict[str, float] = {}
    for fault, size in re.findall(r'-([a-z_]+)-([\d.]+)', name):
        if fault not in FAULTS:
            raise PolicyError(
                f"policy '{text}': unknown fault '{fault}'{nearest(fault, FAULTS)}; known are "
                f'{", ".join(FAULTS)}'
            )
        if fault in sizes:
            raise PolicyError(f"policy '{text}': fault '{fault}' is given twice")
        sizes[fault] = float(size)
    PolicyVariant(tuple(sizes.items()))  # sizes that mean no fault are checked, too
    return PolicyVariant.of(sizes)


def draw_variant(kinds: Sequence[str], rng: np.random.Generator) -> PolicyVariant:
    """Returns a random policy: the expert, or one or two faults of sizes around the typical one.

    Args:
        kinds: to choose from.
        rng: draws.
    """
    count = int(rng.choice([0, 1, 2], p=[0.12, 0.5, 0.38]))
    chosen = rng.choice(kinds, size=min(count, len(kinds)), replace=False)
    sizes = {}
    for kind in map(str, chosen):
        fault = FAULTS[kind]
        size = min(fault.typical * 2 ** rng.normal(0.0, 0.9), fault.largest)
        sizes[kind] = float(f'{size:.3g}')
    return PolicyVariant.of(sizes)


def refuse_kinds(names: Iterable[str], split: str, what: str) -> None:
    """Refuses policies with faults of a split.

    Args:
        names: of policies.
        split: whose kinds must not be there.
        what: they are not for, in words.

    Raises:
        PolicyError: names the policies and their kinds.
    """
    found = {
        name: bad
        for name in names
        if (bad := [k for k in parse_variant(name).kinds if FAULTS[k].split == split])
    }
    if found:
        told = '; '.join(f"'{name}' has {', '.join(kinds)}" for name, kinds in found.items())
        raise PolicyError(
            f'fault kinds of the split {split} are not for {what}: {told}; choose kinds of '
            f'{", ".join(s for s in SPLITS if s != split)} (sim/expert/faults.py)'
        )


def _near(name: str) -> str:
    """Of the first word alone: what follows may be right."""
    first = name.split('-')[0]
    return '' if first == EXPERT else nearest(first, [EXPERT])
