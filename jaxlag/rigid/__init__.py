"""Bodies in space: rotations from coordinates, angular velocities, kinetic energies, joints, contacts and moments of inertia.

Each is a function of q, to be added to L, g and a: no tree of bodies, no engine.

    from jaxlag import rigid

    rotation = rigid.euler("zxz")
    T = rigid.kinetic_energy(m, rigid.inertia.cylinder(m, r, h), position, rotation)  # a function of (q, qdot)
    hinge = rigid.revolute(rigid.frame(position(q), rotation(q)), rigid.frame())  # what has to be zero

The axes of a body are the columns of its rotation matrix R: components in these turn into those in space by R. Angles are in rad and turn
by the right-hand rule; all else is in any consistent set of units.
"""

from . import inertia as inertia
from ._bodies import angular_velocity as angular_velocity
from ._bodies import kinetic_energy as kinetic_energy
from ._frames import Frame as Frame
from ._frames import frame as frame
from ._ground import length as length
from ._ground import on_plane as on_plane
from ._ground import rolling as rolling
from ._ground import rolling_ball as rolling_ball
from ._ground import wheel_height as wheel_height
from ._joints import cylindrical as cylindrical
from ._joints import fixed as fixed
from ._joints import prismatic as prismatic
from ._joints import revolute as revolute
from ._joints import same_axes as same_axes
from ._joints import spherical as spherical
from ._joints import universal as universal
from ._quaternions import quaternion as quaternion
from ._quaternions import quaternion_rate as quaternion_rate
from ._quaternions import to_quaternion as to_quaternion
from ._quaternions import unit as unit
from ._rotations import Euler as Euler
from ._rotations import euler as euler
from ._rotations import rotation as rotation
from ._rotations import rotation_vector as rotation_vector
from ._rotations import rotation_x as rotation_x
from ._rotations import rotation_y as rotation_y
from ._rotations import rotation_z as rotation_z
from ._touching import Touching as Touching
from ._touching import box_plane as box_plane
from ._touching import capsule_plane as capsule_plane
from ._touching import ellipsoid_plane as ellipsoid_plane
from ._touching import sphere_plane as sphere_plane
from ._touching import sphere_sphere as sphere_sphere
