"""XMP does not claim what is not in the file."""

from nlfilter_torch.photo.files import xmp

PACKET = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description
 xmlns:h="http://ns.adobe.com/hdr-gain-map/1.0/" xmlns:GCamera="http://ns.google.com/photos/1.0/camera/"
 xmlns:Container="http://ns.google.com/photos/1.0/container/" xmlns:Item="http://ns.google.com/photos/1.0/container/item/"
 h:Version="1.0" GCamera:MotionPhoto="1" GCamera:MotionPhotoVersion='1' GCamera:Other="2" xmp:Rating="4">
<Container:Directory><rdf:Seq><rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="Primary"/></rdf:li>
<rdf:li rdf:parseType="Resource"><Container:Item Item:Length="3"/></rdf:li></rdf:Seq></Container:Directory>
<h:Max>1</h:Max></rdf:Description></rdf:RDF></x:xmpmeta>"""


def test_statements_about_other_pictures_are_removed() -> None:
    packet, named = xmp.upright(PACKET)
    assert packet is not None
    assert named == [xmp.GAIN_MAP, xmp.MOTION, xmp.PICTURES]
    for gone in (b"hdr-gain-map", b"h:", b"MotionPhoto", b"Container", b"Item"):
        assert gone not in packet.replace(b"xmp", b"").replace(b"http:", b"").replace(b"adobe:ns", b"")
    assert b'GCamera:Other="2" xmp:Rating="4"' in packet
    assert packet.count(b"xmlns:GCamera") == 1
    assert xmp.upright(packet) == (packet, [])


def test_usual_prefixes_need_no_declaration() -> None:
    packet, named = xmp.upright(b'<rdf:Description hdrgm:Version="1.0" GCamera:MotionPhoto="1" a:b="c"/>')
    assert packet == b'<rdf:Description a:b="c"/>'
    assert named == [xmp.GAIN_MAP, xmp.MOTION]
    assert xmp.upright(None) == xmp.upright(b" \n") == (None, [])


FACES = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description xmlns:MP="http://ns.microsoft.com/photo/1.2/"
 xmlns:mwg="http://www.metadataworkinggroup.com/schemas/regions/" xmlns:stArea="http://ns.adobe.com/xmp/sType/Area#"
 xmp:Rating="4"><mwg:Regions rdf:parseType="Resource"><mwg:RegionList><rdf:Bag><rdf:li><rdf:Description mwg:Name="Ann">
<mwg:Area stArea:x="0.2" stArea:y="0.3"/></rdf:Description></rdf:li></rdf:Bag></mwg:RegionList></mwg:Regions>
<MP:RegionInfo><rdf:li/></MP:RegionInfo></rdf:Description></rdf:RDF></x:xmpmeta>"""


def test_places_in_a_turned_picture_are_removed() -> None:
    assert xmp.upright(FACES) == (FACES, [])
    packet, named = xmp.upright(FACES, 6)
    assert packet is not None
    assert set(named) == {xmp.REGIONS}
    assert b"Area " not in packet
    assert b"mwg" not in packet
    assert b"MP:" not in packet
    assert b'xmp:Rating="4"' in packet


def test_long_padding_takes_little_time() -> None:
    packet = PACKET.replace(b"</x:xmpmeta>", b" " * 1_000_000 + b"</x:xmpmeta>")  # quadratic time would be an hour
    assert xmp.upright(packet)[1] == [xmp.GAIN_MAP, xmp.MOTION, xmp.PICTURES]
