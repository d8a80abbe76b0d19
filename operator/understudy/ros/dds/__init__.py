"""What is specific to DDS and to Fast DDS: profiles, locators, discovery, ownership.

No other room names a profile or a locator.
"""
