"""The nine MuJoCo tasks of the delayed-RL papers, with the physics that they were published on.

The papers use Gymnasium's `-v4` tasks on MuJoCo 2. On MuJoCo 3 the same ids are other tasks, because the simulator
changed. This module makes Gymnasium's own environments, and `MuJoCo2` undoes those changes. `docs/tasks.md` says how
closely the result agrees with MuJoCo 2.3.7. `registration` gives the tasks their ids, `delayrl/Ant-v4` and so on.
"""

import hashlib
import re
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs

from delayrl.envs.registration import TASKS as TASKS
from delayrl.envs.registration import register as register
from delayrl.errors import DelayRLError

OLDEST, MARGINS_SUMMED, TOO_NEW = (3, 2, 7), (3, 5, 0), (4, 0, 0)  # MuJoCo versions

# The parts of the model that a fingerprint reads. It leaves out positions and orientations, because the axes of a round
# body's inertia are arbitrary; they show in the simulated steps.
OPTIONS = """
timestep gravity density viscosity integrator solver iterations tolerance cone impratio disableflags
enableflags
"""
CONSTANTS = """
body_mass body_inertia body_invweight0 dof_invweight0 dof_armature dof_damping jnt_type jnt_stiffness
jnt_range jnt_margin jnt_solref jnt_solimp geom_type geom_size geom_contype geom_conaffinity geom_condim
geom_margin geom_gap geom_friction geom_solref geom_solimp actuator_gear actuator_ctrlrange
"""


class MuJoCo2(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Give a Gymnasium MuJoCo environment the physics and the reset observation of MuJoCo 2.3.7.

    The wrapper undoes these changes, listed by the MuJoCo version that introduced them:

    - 3.0: the inverse weight of a body that only slides ignores its joints' armature (Pusher);
    - 3.2: `reset` shows the orientation as it was drawn, not as a unit quaternion (Ant, both Humanoids);
    - 3.3: another algorithm detects the contacts of cylinders (Pusher);
    - 3.5: a contact's margin is the sum of its geoms' margins, not the larger (Ant, Hopper, both Humanoids, Pusher).
    """

    def __init__(self, env: gymnasium.Env[Any, Any]):
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        restore_physics(self.unwrapped)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode. Shows the orientation of free joints as unit quaternions, as MuJoCo did before 3.2."""
        base: Any = self.unwrapped
        restore_physics(base)  # an unpickled environment has loaded its model anew
        observation, info = self.env.reset(seed=seed, options=options)
        free_joints = base.model.jnt_qposadr[base.model.jnt_type == 0]
        for address in free_joints:
            quaternion = base.data.qpos[address + 3 : address + 7]
            quaternion /= np.linalg.norm(quaternion)
        return (base._get_obs() if len(free_joints) else observation), info


class RewardBeforeStep(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Pay for the state in which the action was taken, as Pusher-v4 does. Pusher-v5 pays for the next state."""

    def __init__(self, env: gymnasium.Env[Any, Any]):
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step. The reward and its terms in `info` belong to the state before the step."""
        base: Any = self.unwrapped
        reward, terms = base._get_rew(action)
        observation, _, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, info | terms


def restore_physics(base: Any) -> None:
    """Undo what MuJoCo 3 changed in the compiled model of a Gymnasium `MujocoEnv`. Does nothing the second time.

    Args:
        base: the unwrapped environment; its `model` is changed in place.

    Raises:
        DelayRLError: a MuJoCo version whose changes are not known.
    """
    if getattr(base, "restored_model", None) is base.model:
        return
    import mujoco

    installed, model = mujoco.__version__, base.model
    version = tuple(int(part) for part in re.findall(r"\d+", installed)[:3])
    if not OLDEST <= version < TOO_NEW:
        raise DelayRLError(f"the paper tasks need another MuJoCo than {installed}: pip install 'mujoco>=3.2.7,<4'")
    for flag in ("mjDSBL_NATIVECCD", "mjDSBL_MULTICCD"):  # versions without these flags lack the algorithms too
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, flag, 0))
    if version >= MARGINS_SUMMED:
        # In each task all geoms that can touch have the same margin, so two halves add up to the larger one.
        model.geom_margin[:] *= 0.5
    for body in np.flatnonzero(model.body_simple == 2):  # 2: all its joints are slides
        # MuJoCo 3 uses 1 / mass. Pusher's object has hardly any mass, so that the arm passes through it
        # (https://github.com/Farama-Foundation/Gymnasium/issues/950).
        dofs = slice(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body])
        model.dof_invweight0[dofs] = 1.0 / (model.dof_armature[dofs] + model.body_mass[body])
        model.body_invweight0[body] = model.dof_invweight0[dofs].sum() / 3.0, 0.0  # translation, rotation
    base.restored_model = model


def fingerprint(env: gymnasium.Env[Any, Any]) -> str:
    """Hash the physics of an environment to 16 hexadecimal digits.

    The hash covers the sizes, the model's constants (to 6 digits), and the state that 20 steps with fixed pseudo-random
    controls lead to from the model's initial state (to 1e-5). It ignores rewards, terminations and wrappers. The same
    physics may have other hashes under other MuJoCo versions, so compare within one version. The steps run in a
    simulation of their own and do not change `env`.

    Raises:
        DelayRLError: `env` is not a Gymnasium MuJoCo environment.
    """
    base: Any = env.unwrapped
    if not hasattr(base, "model") or not hasattr(base, "frame_skip"):
        raise DelayRLError(f"a fingerprint needs a Gymnasium MuJoCo environment, not {type(base).__name__}")
    import mujoco

    model = base.model
    sizes = base.observation_space.shape, base.action_space.shape, (base.frame_skip, model.nq, model.nv)
    digest = hashlib.sha256(repr(sizes).encode())
    for source, names in ((model.opt, OPTIONS), (model, CONSTANTS)):
        for name in names.split():
            numbers = np.ravel(np.asarray(getattr(source, name), dtype=np.float64)).tolist()
            digest.update(" ".join([name, *(f"{number:.6g}" for number in numbers)]).encode())

    data = mujoco.MjData(model)
    low, high = model.actuator_ctrlrange.T
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data, nstep=base.frame_skip)
    state = np.round(np.concatenate([data.qpos, data.qvel]), 5) + 0.0  # + 0.0 turns -0.0 into 0.0
    digest.update(repr(state.tolist()).encode())
    return digest.hexdigest()[:16]
