"""Command lines whose outputs are results, and wrong ones whose sentences are; # begins a comment."""

RIGHT = """
--version
--help
presets
presets "soft skin"

# Every edit, with its defaults and with its options.
detail photo.png crisp.png
detail photo.png sliders.png --alpha 3,0.5,2,1.05 --bandwidth 12 --spatial-bandwidth none --patch-size 3 --seed 7
detail photo.png plain.png --limits none --threshold 0 --channels all --residual 1 --landmarks 60 --sampling uniform
detail photo.png drawn.png --bandwidth auto --spatial-bandwidth 9 --landmarks 50 --sampling random --seed 3
detail photo.png viewed.png --viewing-size 0.003 --landmarks 60
detail photo.png region.png --region 10,12,8,6 --show seen.png
detail photo.png regions.png --region 10,12,8,6:3,3,4,1 --region 60%,50%:0,1,1,1 --reach 0.8 --tolerance 12
detail photo.png masked.png --mask mask.png --alpha 0,0.5,1,1
detail photo.png both.png --mask mask.png --region 1,2,3,4
sharpen noisy.png sharp.png
sharpen photo.png sharper.png --amount 7 --guide-blur 0 --limits none --bandwidth auto --landmarks 60
tone photo.png strong.png --contrast 1.4 --clarity 2
tone grey.png weak.png --contrast 0.7 --limits none --viewing-size 0.003 --spatial-bandwidth 10
denoise noisy.png clean.png --map noise.png
denoise noisy.png known.png --noise-level 12 --strength 0.6
denoise noisy.png rule.png --method rule --landmarks 60 --bandwidth 15 --spatial-bandwidth 20
denoise grey.png clean-grey.png --strength 2 --map noise.tif
recolor photo.png blue.png --region 20,25,8,6:blue --keep 70,5,12,10 --show seen-blue.png
recolor photo.png painted.png --strokes strokes.png --reach 0.8 --tolerance 15 --landmarks 60 --spatial-bandwidth 30
colorize grey.png coloured.png --strokes strokes.png --show seen-colour.png
colorize grey.png pale.png --region 30,45,8,8:#b03020 --region 62,36,8,5:#e09a40 --strength 0.8 --patch-size 3
colorize grey.png segments.png --strokes strokes.png --method kmeans --bandwidth 20 --landmarks 60
defocus photo.png focus.png --region 40,15,30,30 --background 5,5,20,20 --show seen-focus.png
defocus photo.png by-hand.png --add 40,15,30,30 --remove 50,20,5,5
defocus photo.png blurred.png --mask mask.png --radius 6 --aperture gaussian --tolerance 12
abstract photo.png flat.png
abstract photo.png painting.png --edges 0.8 --edge-width 0.5 --tones 8 --power 0.5 --bandwidth 20 --patch-size 5
look photo.png sepia.png --matrix .39,.77,.19,.35,.69,.17,.27,.53,.13 --amount 0.8
look photo.png bands.png --landmarks 90 --alpha 2,1.5,1,1 --bands 1.2,1,1.1,1,1,1,0.9 --texture 1,1.3,1,1,1,1
look photo.png curves.png --red 0,0.6,1 --green 0,0.5,1 --blue 0,0.4,1
look photo.png levels.png --saturation 0.5,0.8,1,1.2,1.4 --stretch 0.2,0.5,0.1 --local 0.1,0,0.2,0,0,0.3,0,0.1
mask photo.png selected.png --region 40,15,30,30 --background 5,5,20,20 --show seen-mask.png
mask photo.png refined.tif --mask mask.png --reach 0.8
mask photo.png raster.pfm --region 40,15,30,30 --landmarks 60 --tolerance 14
mask photo.png deep-mask.png --region 40,15,30,30 --depth 16

# Presets and recipes.
detail photo.png soft.png --preset "soft skin"
detail photo.png dramatic.png --preset dramatic --alpha 1,2,3,1
detail photo.png single.png --preset single.json --landmarks 30
apply photo.png crisp-again.png --preset crisp
apply photo.png glow.png --preset glow
apply photo.png every.png --preset every.json
apply photo.png applied.png --preset denoise.json
apply photo.png applied.png --preset detail.json
apply photo.png applied.png --preset recolor.json
apply photo.png applied.png --preset defocus.json
apply photo.png applied.png --preset abstract.json
apply photo.png applied.png --preset look.json
apply grey.png applied.png --preset colorize.json
apply grey.png applied.png --preset look.json
apply photo.png former.png --preset former.json
apply photo.png same.png --preset idle.json
apply photo.png two.png --preset plain.json --mask mask.png --preset look.json --mask rest.png

# Kinds of files.
detail photo.jpg crisp.jpg --landmarks 60
tone clear.png tone-clear.png
tone photo.webp tone.webp
tone photo.jpg tone.avif --landmarks 60
tone deep.png tone-deep.png
tone deep.tif tone-deep.tif
tone float.tif tone-float.tif
tone photo.tif tone-16.tif --depth 16
tone deep.tif tone-8.jpg --depth 8
sharpen photo.tif sharp-float.tif --depth float
recolor float.tif blue-float.tif --region 20,25,8,6:blue
abstract clear.png flat-clear.webp
tone other.png other.png

# In tiles, with little memory, and from and to arrays of zarr.
detail scan.tif tiles.tif --memory 0.05 --landmarks 60
detail scan.tif tiles-full.tif --memory 0.05 --landmarks 60 --full --region 40,60,20,20:0,1,1,1
detail scan.png tiles.png --memory 0.05 --landmarks 60 --residual 1 --viewing-size 0.05
tone scan.tif tiles-tone.tif --memory 0.05 --landmarks 60 --depth 16
sharpen scan.tif tiles-sharp.tif --memory 0.08
abstract scan.tif tiles-flat.tif --memory 0.05 --edges 0.5 --tones 8 --landmarks 60
recolor scan.tif tiles-blue.tif --memory 0.08 --strokes scan-strokes.png
colorize scan-grey.tif tiles-colour.tif --memory 0.08 --strokes scan-strokes.png --show tiles-seen.png
defocus scan.tif tiles-focus.tif --memory 0.08 --region 60,60,50,50 --background 5,5,30,30
mask scan.tif tiles-mask.tif --memory 0.05 --region 60,60,50,50
look scan.tif tiles-look.tif --memory 0.05 --landmarks 60 --local 0.1,0,0.2,0,0,0.3,0,0.1 --alpha 2,1,1,1
denoise scan.tif tiles-clean.tif --memory 0.05 --method rule --landmarks 60
apply scan.tif tiles-every.tif --memory 0.2 --preset every.json
apply scan.png halves.png --memory 0.2 --preset plain.json --mask scan-mask.png --preset look.json --mask scan-rest.png
denoise scan.tif tiles-clean.zarr --map tiles-noise.tif
detail scan.zarr crisp.zarr --landmarks 60 --workers 2
apply scan.zarr every.zarr --preset every.json
defocus deep.zarr focus.zarr --region 40,15,30,30
apply photo.zarr few.zarr --preset few.json --workers 2
abstract photo.zarr flat.zarr --workers 2

# Fits, folders and films.
fit photo.png edited.png fitted.json --preview preview.png --map left.png
apply other.png like-edited.png --preset fitted.json
fit photo.png part.png fitted-part.json --layers 3 --landmarks 60
fit photo.png edited.png regions.json --mask mask.png --mask rest.png
fit before after fitted-folder.json --bandwidth 15
fit photo.png crisp.png
detail other.png other-crisp.png --preset preset.json
inspect photo.png looks
inspect photo.png looks-few --alpha 3,3,4,1.05 --landmarks 40 --viewing-size 0.003 --bandwidth auto --sampling uniform
batch before batch-crisp --preset crisp --workers 2
batch before batch-recipe --preset plain.json --workers 1 --memory 1
batch before batch-crisp --workers 2
frames shots edited-shots
frames shots clean-shots --edit denoise --noise-level 8 --references 2
frames film.mp4 edited.mp4 --landmarks 60
frames film.mp4 plain.mp4 --preset plain.json --references 1
frames film.mp4 sharp.mp4 --edit sharpen --amount 5
demo demo
"""

WRONG = """
embellish
detail
detail photo.png
detail none.png out.png
detail empty.png out.png
detail text.jpg out.png
detail half.png out.png
detail before out.png
detail holed.tif out.tif
detail photo.png out.gif
detail photo.png nowhere/out.png
detail clear.png out.jpg
detail deep.png out.jpg
detail float.tif out.png
detail photo.png out.png --alpha 3
detail photo.png out.png --alpha 3,x
detail photo.png out.png --alpha 3,nan
detail photo.png out.png --bandwidth 0
detail photo.png out.png --bandwidth wide
detail photo.png out.png --spatial-bandwidth -2
detail photo.png out.png --patch-size 4
detail photo.png out.png --patch-size 101
detail photo.png out.png --landmarks 0
detail photo.png out.png --sampling best
detail photo.png out.png --channels red
detail photo.png out.png --residual nan
detail photo.png out.png --depth 12
detail photo.png out.png --memory 0
detail photo.png out.png --memory 0.001
detail photo.png out.png --seed -1
detail photo.png out.png --sharpen
detail photo.png out.png --region 1,2,3
detail photo.png out.png --region 200,200,5,5
detail photo.png out.png --region 1,2,3,4:1,2
detail photo.png out.png --mask scan-mask.png
detail photo.png out.png --preset pretty
detail photo.png out.png --preset plain.json
detail photo.png out.png --show photo.png
detail photo.png out.png --workers 2
detail photo.zarr out.zarr --cluster nowhere
tone photo.png out.png --preset crisp
tone photo.png out.png --contrast inf
denoise photo.png out.png --strength 5
denoise photo.png out.png --map out.png
denoise photo.png out.png --noise-level -1
recolor photo.png out.png
recolor grey.png out.png --region 1,2,8,8:blue
recolor photo.png out.png --region 1,2,8,8:nocolour
recolor photo.png out.png --region 1,2,8,8
recolor photo.png out.png --strokes other.png
recolor photo.png out.png --strokes scan-strokes.png
colorize photo.png out.png
colorize grey.png out.png --method magic --strokes strokes.png
colorize scan-grey.tif out.tif --memory 0.08 --method kmeans --strokes scan-strokes.png
defocus photo.png out.png
defocus photo.png out.png --region 5,5,9,9 --radius 50
abstract photo.png out.png --tones 1
look photo.png out.png --matrix 1,2,3
look photo.png out.png --red 0,1,nan
mask photo.png out.png
mask photo.png out.txt --region 5,5,9,9
apply photo.png out.png
apply photo.png out.png --preset none.json
apply photo.png out.png --preset no-json.json
apply photo.png out.png --preset list.json
apply photo.png out.png --preset newer.json
apply photo.png out.png --preset no-edit.json
apply photo.png out.png --preset entry.json
apply photo.png out.png --preset value.json
apply photo.png out.png --preset range.json
apply photo.png out.png --preset far.json
apply photo.png out.png --preset paint.json
apply photo.png out.png --preset inside.json
apply grey.png out.png --preset recolor.json
apply photo.png out.png --preset plain.json --preset single.json --mask mask.png
fit photo.png
fit photo.png other.png bad.json
fit photo.png photo.png bad.json
fit photo.png edited.png bad.json --layers 1
fit before shots bad.json
presets pretty
batch none out
batch before before
batch before out --preset crisp --workers 0
batch before out --preset plain.json --alpha 1,2
frames none out
frames shots shots
frames film.mp4 out.avi
frames film.mp4 out.mp4 --edit recolor
frames film.mp4 out.mp4 --edit tone --amount 3
frames film.mp4 out.mp4 --preset recolor.json
inspect photo.png photo.png
inspect photo.png nowhere/looks
demo nowhere/demo
app none.png --no-open
app photo.png --port 99999
"""
