# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys


def test_code_that_imports_the_former_name_gets_the_same_modules():
    program = (
        "from blitzgs.scene.pictures import save_image as former\n"
        "from blitzgs.capture.pictures import save_image\n"
        "assert former is save_image\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
