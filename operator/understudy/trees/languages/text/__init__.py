"""What the languages that are texts share: source maps, values with fields, and loading by way of the short form.

What one language alone has is in its own folder.
"""
