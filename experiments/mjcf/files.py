"""Small MJCFs to measure with."""

CART_POLE = """<mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody><body name="cart">
  <joint name="slider" type="slide" axis="1 0 0" damping="0.1"/><geom type="box" size="0.15 0.1 0.08" mass="1"/>
  <body name="pole"><joint name="pole" axis="0 1 0" damping="0.01"/><geom type="capsule" fromto="0 0 0 0 0 0.6"
  size="0.03" mass="0.2" contype="0" conaffinity="0"/></body></body></worldbody>
  <actuator><motor joint="slider" gear="10" ctrlrange="-1 1"/></actuator></mujoco>"""

BOX = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="5 5 0.1"/><body pos="0 0 0.1"><freejoint/>
  <geom type="box" size="0.2 0.15 0.1" mass="1"/><site name="middle"/></body></worldbody>
  <actuator><motor site="middle" gear="1 0 0 0 0 0"/><motor site="middle" gear="0 0 0 0 0 1"/></actuator></mujoco>"""

ARM = """<mujoco><option timestep="0.01" integrator="implicitfast"/><compiler autolimits="true"/>
  <default><joint damping="0.2" armature="0.01"/><geom contype="0" conaffinity="0"/></default><worldbody><body>
  <joint name="a" axis="0 0 1"/><joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
  <body pos="0.4 0 0"><joint name="c" axis="0 1 0"/><joint name="d" axis="1 0 0"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/><body pos="0.4 0 0"><joint name="e" axis="0 1 0"/>
  <joint name="f" axis="1 0 0"/><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02"/></body></body></body>
  </worldbody><actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/><motor joint="d"/><motor joint="e"/>
  <motor joint="f"/></actuator></mujoco>"""

REACHER = """<mujoco model="reacher"><option timestep="0.01" integrator="implicitfast"/><compiler autolimits="true"/>
  <default><joint axis="0 -1 0" damping="0.3" frictionloss="0.2" armature="0.02"/><geom contype="0" conaffinity="0"/>
  </default><worldbody><body name="upper"><joint name="turn" axis="0 0 1"/><joint name="shoulder" range="-170 170"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1.2"/><body name="fore" pos="0.4 0 0">
  <joint name="elbow" range="-150 150"/><geom type="capsule" fromto="0 0 0 0.35 0 0" size="0.025" mass="0.7"/>
  <body name="hand" pos="0.4 0 0"><geom type="sphere" size="0.04" mass="0.3"/></body></body></body></worldbody>
  <actuator><motor name="turn_motor" joint="turn" gear="1" ctrlrange="-25 25"/><motor name="shoulder_motor"
  joint="shoulder" gear="1" ctrlrange="-40 40"/><motor name="elbow_motor" joint="elbow" gear="1" ctrlrange="-15 15"/>
  </actuator></mujoco>"""

# That of docs/arms.md.
TWO_LINKS = """<mujoco model="two_links"><option timestep="0.01" integrator="implicitfast"/>
  <compiler autolimits="true"/><default><joint axis="0 -1 0" damping="0.5" armature="0.02"/><geom size="0.03"/>
  </default><worldbody><geom name="post" type="cylinder" size="0.05 0.3" pos="0.55 0 -0.25"/>
  <body name="base" pos="0 0 0.3">
  <geom name="base" type="cylinder" size="0.04 0.03"/><body name="upper"><joint name="shoulder" range="-170 170"/>
  <geom type="capsule" fromto="0.1 0 0 0.4 0 0" mass="1"/><body name="fore" pos="0.4 0 0">
  <joint name="elbow" range="-150 150"/><geom type="capsule" fromto="0.08 0 0 0.35 0 0" mass="0.5"/></body></body>
  </body></worldbody><actuator><motor name="shoulder" joint="shoulder" ctrlrange="-20 20"/>
  <motor name="elbow" joint="elbow" ctrlrange="-8 8"/></actuator></mujoco>"""

FILES = {"cart-pole": CART_POLE, "box on the floor": BOX, "arm of six hinges": ARM}
