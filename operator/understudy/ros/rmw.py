"""Selects the middleware of this version of Understudy."""

from __future__ import annotations

from understudy.ros.dds.fast_dds import FastDds
from understudy.ros.middleware import Middleware

MIDDLEWARE: Middleware = FastDds()
