"""Moved to tests/support; this name goes when nothing that is under way uses it any more."""

from tests.support.ros_peer import Peer as Peer
from tests.support.ros_peer import adding as adding
from tests.support.ros_peer import command as command
from tests.support.ros_peer import drive as drive
from tests.support.ros_peer import pause as pause
from tests.support.ros_peer import removing as removing
from tests.support.ros_peer import say_hello as say_hello
from tests.support.ros_peer import set_bool as set_bool
from tests.support.waiting import get as get
from tests.support.waiting import until as until
