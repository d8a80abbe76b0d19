"""The middleware Fast DDS: XML profiles, discovery by RTPS, host ids in GUIDs, and exclusive ownership.

fast_dds.py implements the interface in ros/middleware.py. No other room imports from here.
"""
