"""The exported controller as a Drake system. Needs pydrake, numpy, and `rtcd_controller.py` beside it.

    plant, scene = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    Parser(plant).AddModels("robot.urdf")
    plant.Finalize()
    controller = builder.AddSystem(ControllerSystem())
    builder.Connect(plant.get_state_output_port(), controller.get_input_port())
    builder.Connect(controller.GetOutputPort("input"), plant.get_actuation_input_port())

The motion starts at the context's time `start`. The input is evaluated whenever the simulator asks; a real robot's
hold is Drake's ZeroOrderHold between the two.
"""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import LeafSystem
from rtcd_controller import Controller


class ControllerSystem(LeafSystem):
    """Input port `state` [n]: positions, then velocities. Output ports: `input` [m], and `monitor` [2], the ratio and
    1.0 where the monitor advises to abort.
    """

    def __init__(self, controller: Controller | None = None, start: float = 0.0):
        LeafSystem.__init__(self)
        self.controller, self.start = controller or Controller(), start
        self.DeclareVectorInputPort("state", len(self.controller.x_goal))
        self.DeclareVectorOutputPort("input", len(self.controller.u_max), self._input)
        self.DeclareVectorOutputPort("monitor", 2, self._monitor)

    def _now(self, context) -> tuple[float, np.ndarray]:
        return context.get_time() - self.start, self.get_input_port().Eval(context)

    def _input(self, context, output) -> None:
        output.SetFromVector(self.controller.control(*self._now(context)))

    def _monitor(self, context, output) -> None:
        watch = self.controller.monitor(*self._now(context))
        output.SetFromVector([watch.ratio, float(watch.abort)])
