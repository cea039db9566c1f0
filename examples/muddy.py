"""A dynamics shift of your own: slippery ground and a load on the back.

twirl evaluate assets/policies/biped.npz --shifts none examples/muddy.py:MUDDY
twirl train --task biped --shift examples/muddy.py:MUDDY --source runs/biped-twirl-cpu-s0
"""

from twirl_mjx import Shift

MUDDY = Shift("muddy", about="mud underfoot, 1.5 kg on the back", friction=0.5, payload=1.5)
