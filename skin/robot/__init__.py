"""The skin in a robot's world: on a geom of MuJoCo, in recordings of LeRobot and MCAP."""

from skin.robot.mujoco_skin import MujocoSkin as MujocoSkin
