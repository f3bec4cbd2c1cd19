"""Pipelines around world models of tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mtv_world_ros.control.registry import create_control
from mtv_world_ros.model.card import CheckpointCard
from mtv_world_ros.model.checkpoint import control_options
from mtv_world_ros.robot.model import RobotModel
from mtv_world_ros.rollout.pipeline import Pipeline, WorldModel
from mtv_world_ros.rollout.success_judge import SuccessJudge
from mtv_world_ros.vision.segmenters.choose import choose_segmenter


def assembled(
    card: CheckpointCard, world_model: WorldModel, robot: RobotModel, **of_judge: Any
) -> Pipeline:
    """Return a pipeline with the control of a card, and a judge without a calibration.

    Args:
        card: card of a checkpoint.
        world_model: predicts chunks.
        robot: robot that acts.
        of_judge: fields of the `SuccessJudge`.
    """
    segmenter = choose_segmenter()
    return Pipeline(
        robot=robot,
        world_model=world_model,
        segmenter=segmenter,
        judge=replace(SuccessJudge.of(robot, segmenter), **of_judge),
        control=create_control(card.control, control_options(card, robot)),
    )
