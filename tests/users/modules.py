"""Write the modules that the pages of the documentation show into folders: `python modules.py DOCS WORK PACKAGE`.

WORK gets what lies in a user's working folder, PACKAGE what an installed package of hers holds. So the scripts run the
pages' code as it stands.
"""

import re
import sys
from pathlib import Path

INSTALLED = ("late_ddpg.py", "my_laws.py")

docs, work, package = map(Path, sys.argv[1:])
for page in ("own-task.md", "own-agent.md", "delays.md", "measure.md"):
    for block in re.findall(r"^```python\n(# \w+\.py\n.*?)^```", (docs / page).read_text(), re.MULTILINE | re.DOTALL):
        name = block.split()[1]
        ((package if name in INSTALLED else work) / name).write_text(block)
