"""G'MIC and darktable, run from the command line on the tasks nearest to ``detail``, where they are installed.

G'MIC's details equalizer raises four scales of detail of the luminance, darktable's local contrast is a local Laplacian
filter. Their settings change a photograph about as much as sliders of 2 do.
"""

import shutil
import struct
from collections.abc import Callable
from functools import cache
from pathlib import Path

GAIN = 0.25  # of G'MIC's four scales
CLARITY = 0.75  # darktable's detail, shown as 175 %
LUMINANCE = 11  # G'MIC's number of that channel
XMP = """<?xml version="1.0" encoding="UTF-8"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:darktable="http://darktable.sf.net/" darktable:xmp_version="5"
   darktable:auto_presets_applied="1" darktable:history_end="1" darktable:iop_order_version="2">
   <darktable:history>
    <rdf:Seq>
     <rdf:li darktable:num="0" darktable:operation="bilat" darktable:enabled="1" darktable:modversion="3"
      darktable:params="{parameters}" darktable:multi_name="" darktable:multi_priority="0"/>
    </rdf:Seq>
   </darktable:history>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
"""


def gmic(source: Path, target: Path, folder: Path) -> list[str]:
    """The command for a file of 8 or, if it is a TIFF file, 16 bits; TIFF files are written as floats."""
    scales = f"0,0,2,{GAIN}," * 4
    deep = source.suffix == ".tif"
    before, after = (["/", "257"], ["/", "255"]) if deep else ([], [])
    work = ["fx_equalize_details", f"5,0.5,{scales}{LUMINANCE},0,0,32"]
    return ["gmic", str(source), *before, *work, *after, "output", f"{target},float" if deep else str(target)]


def darktable(source: Path, target: Path, folder: Path, *options: str) -> list[str]:
    """The command, with its settings and caches in a folder; TIFF files are written as floats."""
    edit = folder / "darktable.xmp"
    local_laplacian = struct.pack("<Iffff", 1, 0.5, 0.5, CLARITY, 0.5)
    edit.write_text(XMP.format(parameters=local_laplacian.hex()))
    core = ["--configdir", str(folder / "darktable"), "--cachedir", str(folder / "darktable")]
    core += ["--library", ":memory:", "--disable-opencl", "--conf", "plugins/imageio/format/tiff/bpp=32"]
    return ["darktable-cli", str(source), str(edit), str(target), *options, "--core", *core]


#: By program: from a photograph, the file to write and a folder for temporary files to the command.
EDITORS: dict[str, Callable[..., list[str]]] = {"gmic": gmic, "darktable-cli": darktable}


@cache
def installed() -> dict[str, Callable[..., list[str]]]:
    """Those of :data:`EDITORS` that are installed; says which are not."""
    programs = {name: command for name, command in EDITORS.items() if shutil.which(name)}
    for name in EDITORS.keys() - programs.keys():
        print(f"{name} is not installed here (Debian: apt-get install gmic darktable), and is left out")
    return programs
