"""What a competition controller may import, supplied when a submission does not bring its own.

The files here are loaded *by the submission*, under the names it expects; nothing else of the
package imports them.
"""
