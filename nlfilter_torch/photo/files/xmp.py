"""XMP packets: what they say about the orientation, places in the picture, and other pictures in the file."""

import re

# Pixels are turned upright when read, but XMP may repeat the original orientation.
ORIENTATION = re.compile(rb"(tiff:Orientation\s*(?:=\s*[\"']|>)\s*)[1-8]")
MOTION = "the video of a motion photo"
PICTURES = "further pictures"
GAIN_MAP = "a gain map"
DEPTH = "a depth map"
GOOGLE = b"http://ns.google.com/photos/1.0/"
#: Statements by their namespace: the usual prefix, the names (None for all), and what they state to be in the file.
STATEMENTS: dict[bytes, tuple[bytes, bytes | None, str]] = {
    b"http://ns.adobe.com/hdr-gain-map/1.0/": (b"hdrgm", None, GAIN_MAP),
    b"http://ns.apple.com/HDRGainMap/1.0/": (b"HDRGainMap", None, GAIN_MAP),
    GOOGLE + b"camera/": (b"GCamera", rb"(?:MotionPhoto|MicroVideo)\w*", MOTION),
    GOOGLE + b"container/": (b"Container", None, PICTURES),
    GOOGLE + b"container/item/": (b"Item", None, PICTURES),
    GOOGLE + b"depthmap/": (b"GDepth", None, DEPTH),
    GOOGLE + b"image/": (b"GImage", None, PICTURES),
    GOOGLE + b"audio/": (b"GAudio", None, "sound"),
    b"http://ns.google.com/photos/dd/1.0/device/": (b"Device", None, PICTURES),
    b"http://ns.apple.com/pixeldatainfo/1.0/": (b"apdi", None, PICTURES),
    b"http://ns.adobe.com/xmp/note/": (b"xmpNote", b"HasExtendedXMP", "an extension of XMP"),
}
REGIONS = "regions of the picture such as faces, as it is turned"
#: Statements about places in the picture.
PLACES: dict[bytes, tuple[bytes, bytes | None, str]] = {
    b"http://www.metadataworkinggroup.com/schemas/regions/": (b"mwg-rs", None, REGIONS),
    b"http://ns.microsoft.com/photo/1.2/": (b"MP", b"RegionInfo", REGIONS),
    b"http://ns.apple.com/faceinfo/1.0/": (b"apple-fi", None, REGIONS),
}


def upright(xmp: bytes | None, orientation: int = 1) -> tuple[bytes | None, list[str]]:
    """An XMP packet of an upright picture, and what was in it and is left out.

    Args:
        xmp: as it stands in the file. Its orientation is set to 1, and statements about other pictures are left out.
        orientation: of the picture as it is stored; of a turned one, places in it are left out.
    """
    if not isinstance(xmp, bytes) or not xmp.strip(b"\0 \r\n\t"):
        return None, []
    xmp = ORIENTATION.sub(rb"\g<1>1", xmp)
    named = []
    statements = STATEMENTS | (PLACES if orientation > 1 else {})
    for namespace, (usual, names, content) in statements.items():
        declared = re.findall(rb"xmlns:([\w.-]+)\s*=\s*[\"']" + re.escape(namespace) + rb"[\"']", xmp)
        for prefix in dict.fromkeys([*declared, usual]):
            shorter = _without(xmp, prefix, names or rb"[\w.-]+")
            if shorter != xmp:
                named.append(content)
                xmp = shorter
    return (_without_declarations(xmp) if named else xmp), named


def _without(xmp: bytes, prefix: bytes, names: bytes) -> bytes:
    """The packet without attributes and elements of these names."""
    name = re.escape(prefix) + rb":(" + names + rb")"
    # One space before it, since many of them at a time would take quadratic time in packets with padding.
    xmp = re.sub(rb"\s" + name + rb"\s*=\s*(?:\"[^\"]*\"|'[^']*')", b"", xmp)
    end = rb"</" + re.escape(prefix) + rb":\1\s*>"
    return re.sub(rb"<" + name + rb"(?=[\s/>])(?:[^<>]*/>|[^<>]*>.*?" + end + rb")\s*", b"", xmp, flags=re.DOTALL)


def _without_declarations(xmp: bytes) -> bytes:
    """The packet without declarations of these namespaces that are not used any more."""
    for namespace in STATEMENTS | PLACES:
        declaration = rb"\sxmlns:([\w.-]+)\s*=\s*[\"']" + re.escape(namespace) + rb"[\"']"
        for prefix in re.findall(declaration, xmp):
            rest = re.sub(declaration, b"", xmp)
            xmp = xmp if re.search(rb"[\s<]" + re.escape(prefix) + rb":", rest) else rest
    return xmp
