"""Descriptions of the arm `maker_arms.ARMS["krl"]` in forms of other simulators."""

MJCF = """<mujoco model="lab">
  <compiler angle="degree" eulerseq="zyx"/>
  <default><default class="arm"><joint axis="0 1 0"/></default></default>
  <!-- the arm of bay 3 -->
  <worldbody>
    <light pos="0 0 3"/>
    <body name="base" pos="0.3 0 0.1" childclass="arm">
      <body name="l1" pos="0 0 0.45" euler="0 0 0">{i}<joint name="a1" axis="0 0 -1"/>
      <body name="l2" pos='0.15 0 0'>{i}<joint name="a2"/>
      <body name="l3" pos="0.61 0.1 0">{i}<joint name="a3" pos="0 -0.1 0"/>
      <body name="l4" pos="0 -0.1 0.02" quat="0.7071067811865476 0 0.7071067811865476 0">{i}
        <joint name="a4" axis="0 0 -1"/>
      <body name="l5" pos="0 0 0.66" xyaxes="1 0 0 0 1 0">{i}<joint name="a5"/>
      <body name="l6" pos="0 0 0" axisangle="0 0 1 30">{i}<joint name="a6" axis="0 0 -1"/>
        <body name="flange" pos="0 0 0.08" euler="-30 0 0">{i}</body>
      </body></body></body></body></body></body>
    </body>
  </worldbody>
</mujoco>
""".replace("{i}", '<inertial mass="3" pos="0 0 0" diaginertia="1 1 1"/>')
SDF = """<?xml version="1.0"?>
<sdf version="1.9"><model name="lab"><pose>1 2 3 0 0 0</pose>
<link name="base"/>
<link name="l1"><pose>0.0 0 0.45 0 0 0</pose></link>
<joint name="a1" type="revolute"><parent>base</parent><child>l1</child>
  <axis><xyz>0 0 -1</xyz></axis></joint>
<joint name="a2" type="revolute"><pose relative_to="l1">0.15 0 0 0.3 0 0</pose><parent>l1</parent>
  <child>l2</child><axis><xyz expressed_in="__model__">0 1 0</xyz></axis></joint>
<link name="l2"><pose relative_to="a2">0 0 0 -0.3 0 0</pose></link>
<link name="l3"><pose>0.76 0 0.45 0 0 0</pose></link> <!-- by hand -->
<joint name="a3" type="revolute"><parent>l2</parent><child>l3</child>
  <axis><xyz>0 1 0</xyz></axis></joint>
<link name="l4"><pose relative_to="l3">0 0 0.02 0 0 0</pose></link>
<joint name="a4" type="revolute"><pose>0 0 0 0 0.2 0</pose><parent>l3</parent><child>l4</child>
  <axis><xyz expressed_in="l4">-1 0 0</xyz></axis></joint>
<link name="l5"><pose>1.42 0 0.47 0 0 0</pose></link>
<joint name="a5" type="revolute"><parent>l4</parent><child>l5</child>
  <axis><xyz>0 1 0</xyz></axis></joint>
<link name="l6"><pose>1.42 0 0.47 0 0 0</pose></link>
<joint name="a6" type="revolute"><parent>l5</parent><child>l6</child>
  <axis><xyz>-1 0 0</xyz></axis></joint>
<link name="tool0"><pose relative_to="l6">0.08 0 0 0 1.5707963267948966 0</pose></link>
<joint name="flange" type="fixed"><parent>l6</parent><child>tool0</child></joint>
<link name="gripper"><pose>1.6 0 0.47 0 0 0</pose></link>
<joint name="hold" type="fixed"><parent>tool0</parent><child>gripper</child></joint>
</model></sdf>
"""
