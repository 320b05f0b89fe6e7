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
  <default><joint damping="0.2" armature="0.01"/><geom contype="0" rgba=".8 .8 .82 1"/></default><worldbody><body>
  <joint name="a" axis="0 0 1"/><joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
  <body pos="0.4 0 0"><joint name="c" axis="0 1 0"/><joint name="d" axis="1 0 0"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/><body pos="0.4 0 0"><joint name="e" axis="0 1 0"/>
  <joint name="f" axis="1 0 0"/><geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02"/>
  <site name="hand" pos="0.22 0 0"/></body></body></body></worldbody><actuator>
  <motor joint="a"/><motor joint="b"/><motor joint="c"/><motor joint="d"/><motor joint="e"/>
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

# A body with eight thrusters in water, neutrally buoyant, and what is in its way. The guard is what collides.
PILLARS = """
  <geom name="pillar_a" type="cylinder" size=".35 2" pos="1.6 .15 2"/>
  <geom name="pillar_b" type="cylinder" size=".35 2" pos="3.4 -.35 2"/>
  <geom name="dock" type="box" size=".1 .5 .4" pos="-.7 0 1"/>"""
THRUSTERS = f"""<mujoco model="thrusters"><compiler autolimits="true"/>
  <option timestep="0.02" integrator="implicitfast" density="1000" viscosity="0.001"/>
  <default><general ctrlrange="-35 35"/><geom rgba=".55 .55 .5 1"/></default><worldbody>
  <light pos="0 -4 8" dir="0 .4 -1" directional="true"/><camera name="overview" pos="2.2 -5.5 3.7"
  xyaxes="1 0 0 0 .45 .9"/><geom name="seabed" type="plane" size="12 12 .1" rgba=".75 .7 .55 1"/>{PILLARS}
  <body name="rov" pos="0 0 1" gravcomp="1"><freejoint name="rov"/>
  <geom name="guard" type="sphere" size=".25" mass="0" rgba="0 0 0 0"/>
  <geom name="hull" type="ellipsoid" size=".25 .18 .13" mass="11.5" contype="0" conaffinity="0" rgba=".1 .3 .9 1"/>
  <site name="t1" pos=".15 -.11 0"/><site name="t2" pos=".15 .11 0"/><site name="t3" pos="-.15 -.11 0"/>
  <site name="t4" pos="-.15 .11 0"/><site name="v1" pos=".12 -.2 0"/><site name="v2" pos=".12 .2 0"/>
  <site name="v3" pos="-.12 -.2 0"/><site name="v4" pos="-.12 .2 0"/></body></worldbody><actuator>
  <general name="t1" site="t1" gear=".7071 .7071 0 0 0 0"/><general name="t2" site="t2" gear=".7071 -.7071 0 0 0 0"/>
  <general name="t3" site="t3" gear=".7071 -.7071 0 0 0 0"/><general name="t4" site="t4" gear=".7071 .7071 0 0 0 0"/>
  <general name="v1" site="v1" gear="0 0 1 0 0 0"/><general name="v2" site="v2" gear="0 0 1 0 0 0"/>
  <general name="v3" site="v3" gear="0 0 1 0 0 0"/><general name="v4" site="v4" gear="0 0 1 0 0 0"/>
  </actuator></mujoco>"""

# A quadrotor with a load on a rod, which hangs from its centre of mass, whatever its attitude.
SLUNG_LOAD = """<mujoco model="slung_load"><compiler autolimits="true" angle="radian"/>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 -9.8"/><default><geom contype="0" conaffinity="0"/>
  <general ctrlrange="0 3.71"/></default><worldbody><light pos="0 -4 8" dir="0 .4 -1"/><body name="middle" pos="0 0 2">
  <joint name="x" type="slide" axis="1 0 0" damping="0.15"/><joint name="y" type="slide" axis="0 1 0" damping="0.15"/>
  <joint name="z" type="slide" axis="0 0 1" damping="0.15" ref="2"/><inertial pos="0 0 0" mass="0.1"
  diaginertia="1e-9 1e-9 1e-9"/><body name="quadrotor"><joint name="turn" type="ball"/><inertial pos="0 0 0" mass="0.4"
  diaginertia="0.05 0.05 0.05"/><geom type="capsule" size="0.02" fromto="-0.17 0 0 0.17 0 0"/><geom type="capsule"
  size="0.02" fromto="0 -0.17 0 0 0.17 0"/><site name="a" pos="0.17 0 0"/><site name="b" pos="0 0.17 0"/>
  <site name="c" pos="-0.17 0 0"/><site name="d" pos="0 -0.17 0"/></body><body name="load">
  <joint name="roll" axis="1 0 0" range="-1.2 1.2"/><joint name="pitch" axis="0 1 0" range="-1.2 1.2"/>
  <inertial pos="0 0 -0.8" mass="0.2" diaginertia="1e-9 1e-9 1e-9"/><geom type="capsule" size="0.005"
  fromto="0 0 0 0 0 -0.8"/><geom type="sphere" size="0.06" pos="0 0 -0.8"/></body></body></worldbody><actuator>
  <general site="a" gear="0 0 1 0 0 0.025"/><general site="b" gear="0 0 1 0 0 -0.025"/>
  <general site="c" gear="0 0 1 0 0 0.025"/><general site="d" gear="0 0 1 0 0 -0.025"/></actuator></mujoco>"""

# On a floor, each with something that it can push, kick or pick up, whose name is "body".
_FLOOR = """<mujoco model="contacts"><compiler autolimits="true"/>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default><geom rgba=".25 .4 .6 1"/></default><worldbody><geom type="plane" size="3 3 0.1" rgba=".85 .85 .8 1"/>
  <light pos="0 -1 3" dir="0 .3 -1" directional="true"/>
  <camera name="overview" pos="0 -1 .55" xyaxes="1 0 0 0 .4 .92" fovy="27"/>"""
DISC = f"""{_FLOOR}<body pos="-0.3 0 0.05"><joint name="x" type="slide" axis="1 0 0" damping="2"/>
  <joint name="y" type="slide" axis="0 1 0" damping="2"/><geom name="disc" type="cylinder" size="0.05 0.03" mass="1"/>
  </body><body name="body" pos="0 0 0.06"><freejoint name="body"/><geom type="box" size="0.06 0.06 0.06"
  mass="0.5" rgba=".9 .4 .1 1"/></body></worldbody><actuator><motor joint="x" ctrlrange="-20 20"/>
  <motor joint="y" ctrlrange="-20 20"/></actuator></mujoco>"""
FOREARM = f"""{_FLOOR}<body pos="0 0 0.05"><joint name="a" axis="0 0 1" damping="0.2"/><geom type="capsule"
  fromto="0 0 0 0.3 0 0" size="0.025" mass="0.5"/><body pos="0.3 0 0"><joint name="b" axis="0 0 1" damping="0.2"
  range="-150 150"/><geom name="forearm" type="capsule" fromto="0.03 0 0 0.3 0 0" size="0.025" mass="0.4"/></body>
  </body><body name="body" pos="0.35 0.2 0.03"><joint name="body_x" type="slide" axis="1 0 0" damping="1"/>
  <joint name="body_y" type="slide" axis="0 1 0" damping="1"/><geom type="cylinder" size="0.04 0.03" mass="0.2"
  rgba=".9 .4 .1 1"/>
  </body></worldbody><actuator><motor joint="a" ctrlrange="-10 10"/><motor joint="b" ctrlrange="-5 5"/></actuator>
  </mujoco>"""
LEG = f"""{_FLOOR}<body pos="0 0 0.75"><joint name="hip" axis="0 1 0" damping="0.5" range="-90 90"/><geom type="capsule"
  fromto="0 0 0 0 0 -0.35" size="0.04" mass="2"/><body pos="0 0 -0.35"><joint name="knee" axis="0 1 0" damping="0.5"
  range="0 120"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="1"/><geom name="foot" type="box"
  pos="0.05 0 -0.32" size="0.08 0.04 0.02" mass="0.3"/></body></body><body name="body" pos="0.25 0 0.1">
  <freejoint name="body"/><geom type="sphere" size="0.1" mass="0.4" rgba=".9 .4 .1 1"/></body></worldbody><actuator>
  <motor joint="hip" ctrlrange="-60 60"/><motor joint="knee" ctrlrange="-60 60"/></actuator></mujoco>"""
GRIPPER = f"""{_FLOOR}<body pos="0 0 0.35"><joint name="x" type="slide" axis="1 0 0" damping="5"/><joint name="y"
  type="slide" axis="0 1 0" damping="5"/><joint name="z" type="slide" axis="0 0 1" damping="5"/><geom type="box"
  size="0.06 0.03 0.015" mass="0.5"/><body pos="0.05 0 -0.06"><joint name="left" type="slide" axis="-1 0 0"
  range="0 0.04" damping="2"/><geom name="left" type="box" size="0.006 0.02 0.04" mass="0.05" friction="1.5"/></body>
  <body pos="-0.05 0 -0.06"><joint name="right" type="slide" axis="1 0 0" range="0 0.04" damping="2"/><geom
  name="right" type="box" size="0.006 0.02 0.04" mass="0.05" friction="1.5"/></body></body><body name="body"
  pos="0 0 0.025"><freejoint name="body"/><geom type="box" size="0.025 0.025 0.025" mass="0.1" friction="1.5"
  rgba=".9 .4 .1 1"/></body></worldbody><actuator><motor joint="x" ctrlrange="-20 20"/>
  <motor joint="y" ctrlrange="-20 20"/><motor joint="z" ctrlrange="-30 30"/>
  <motor joint="left" ctrlrange="-10 10"/><motor joint="right" ctrlrange="-10 10"/></actuator></mujoco>"""

FILES = {"cart-pole": CART_POLE, "box on the floor": BOX, "arm of six hinges": ARM}
