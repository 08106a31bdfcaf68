"""The skin in a robot's world: on a geom of MuJoCo."""

from skin.robot.mujoco_skin import MujocoSkin as MujocoSkin
