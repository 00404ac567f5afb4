"""Small planar documents of MuJoCo, made of parts."""

WORLD = """
<mujoco><option gravity="0 -9.81 0"/><compiler angle="radian" autolimits="true"/>
  <worldbody>{world}
    <body name="thing" pos="0 {height} 0">
      {joints}<geom name="skin" {geom}/>{more}
    </body>
    {others}
  </worldbody>{sections}
</mujoco>
"""
SLIDES = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
FREE = SLIDES + '<joint type="hinge" axis="0 0 1"/>'
BOX = 'type="box" size="0.2 0.1 0.1"'
QUIET = BOX + ' contype="0" conaffinity="0"'
BRAKE = '<general gainprm="0" biastype="affine" biasprm="{bias}" {place}/>'


def document(
    world="", joints=FREE, geom=QUIET, more="", others="", sections="", height=0.6
):
    return WORLD.format(
        world=world,
        joints=joints,
        geom=geom,
        more=more,
        others=others,
        sections=sections,
        height=height,
    )
