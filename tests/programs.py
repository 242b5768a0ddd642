"""Moved to tests/support; this name goes when nothing that is under way uses it any more."""

from tests.support.processes import ROOT as ROOT
from tests.support.processes import START_S as START_S
from tests.support.processes import STOP_S as STOP_S
from tests.support.programs import Program as Program
from tests.support.programs import ended as ended
from tests.support.programs import free_port as free_port
from tests.support.programs import macs as macs
